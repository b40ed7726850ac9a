import re

from hypothesis import given
from hypothesis import strategies as st

from coil_rl.replay.names import numbered, of_runs, plain, repeated


@given(st.text("aZ09_-. =,/日é", max_size=8))
def test_any_label_becomes_a_name_that_a_topic_may_have(label):
    assert re.fullmatch(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", plain(label))
    assert plain(plain(label)) == plain(label)


def test_a_label_that_is_its_own_stays_as_it_is():
    assert of_runs(["ppo", "coil"], [0, 0]) == ["ppo", "coil"]


def test_runs_of_one_label_are_told_apart_by_seed_and_then_by_number():
    assert of_runs(["coil", "ppo", "coil"], [1, 1, 0]) == ["coil_seed1", "ppo", "coil_seed0"]
    assert of_runs(["coil", "coil"], [0, 0]) == ["coil_seed0_1", "coil_seed0_2"]
    assert numbered(["a", "b", "a"]) == ["a_1", "b", "a_2"]


def test_what_still_comes_twice_is_found():
    assert repeated(["a", "b", "b", "a"]) == "b"
    assert repeated(["a", "b"]) is None
