import time

import pytest

from coil_rl.benchmark.turns import Sections, Turns, median_ratio


def test_subjects_take_turns_after_a_warm_up():
    called = []

    def subject(name):
        def work():
            called.append(name)
            time.sleep(0.01)
            return 5

        return work

    ticks = []
    rates = Turns(0.0, 3, "cpu", ticks.append).rates({"a": subject("a"), "b": subject("b")}, "x: ")
    assert called == ["a", "b"] * 4
    assert ticks[:3] == ["x: a, warm-up", "x: b, warm-up", "x: a"]
    assert {name: len(rounds) for name, rounds in rates.items()} == {"a": 3, "b": 3}
    assert all(0 < rate <= 500 for rounds in rates.values() for rate in rounds)


def test_a_turn_lasts_its_share_of_the_seconds():
    calls = []
    Turns(0.1, 2, "cpu").rates({"a": lambda: calls.append(time.perf_counter()) or 1})
    assert calls[-1] - calls[1] >= 0.09


def test_median_ratio_is_taken_within_rounds():
    # The machine was slow in the second round: a ratio of medians would be 10 / 4.
    assert median_ratio([10, 2, 20], [5, 1, 4]) == 2


def test_sections_are_charged_for_what_no_section_inside_them_is():
    class Work:
        def outer(self):
            time.sleep(0.02)
            return self.inner()

        def inner(self):
            time.sleep(0.05)
            return 7

    work, sections = Work(), Sections("cpu")
    sections.wrap(work, "outer", "outer")
    sections.wrap(work, "inner", "inner")
    start = time.perf_counter()
    with sections.section("rest"):
        assert work.outer() == 7
    whole = time.perf_counter() - start
    assert sections.seconds["inner"] >= 0.05
    assert 0.02 <= sections.seconds["outer"] <= whole - 0.05
    assert sum(sections.seconds.values()) == pytest.approx(whole, abs=0.005)


def test_a_section_that_raises_is_closed():
    sections = Sections("cpu")

    def fail():
        with sections.section("rest"):
            raise ValueError("mine")

    with pytest.raises(ValueError, match="mine"):
        fail()
    with sections.section("later"):
        pass
    assert set(sections.seconds) == {"rest", "later"}
