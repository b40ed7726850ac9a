import json
from argparse import Namespace

import pytest

from benchmarks.__main__ import PARTS, main
from benchmarks.timing import Stopwatch, measure, median_ratio


class Clock:
    """A clock of which each piece of work takes a second."""

    now = 0

    def __call__(self):
        return self.now

    def work(self):
        self.now += 1
        return 5


def test_subjects_alternate_after_a_warm_up():
    clock, calls = Clock(), []

    def subject(name):
        return lambda: calls.append(name) or clock.work()

    given = Namespace(seconds=0.0, repeats=3)
    rates = measure(given, {"a": subject("a"), "b": subject("b")}, clock)
    assert calls == ["a", "b"] * 4
    assert rates == {"a": [5] * 3, "b": [5] * 3}
    # A ratio of medians would be 10 / 4: the second round was slow.
    assert median_ratio([10, 2, 20], [5, 1, 4]) == 2


def test_stopwatch_counts_the_outer_of_two_methods():
    class Work(Clock):
        def outer(self):
            return self.work() + self.work()

    work = Work()
    stopwatch = Stopwatch(work)
    stopwatch.wrap(work, "outer", "outer")
    stopwatch.wrap(work, "work", "inner")
    assert work.outer() == 2 * work.work()
    assert stopwatch.seconds == {"outer": 2, "inner": 1}


@pytest.mark.slow
def test_quick_run_measures_everything(tmp_path, capsys):
    parts = [name for name in PARTS if name != "compiled"]
    arguments = ["track=generated", "track.train.count=1", "--quick"]
    arguments += ["--output", str(tmp_path / "run")]
    main(arguments)
    results = json.loads((tmp_path / "run" / "benchmark.json").read_text())
    assert set(results) == {"versions", "settings", "goals", *parts}
    for row in results["shares"]:
        shares = [row[key] for key in ("env", "guide", "policy", "update", "framework")]
        assert sum(shares) == pytest.approx(1)
    assert all(172 < row["state per car (B)"] < 2000 for row in results["processes"])
    assert (tmp_path / "run" / "benchmark.md").read_text() in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(arguments)
    assert "already holds a benchmark" in capsys.readouterr().err


@pytest.mark.slow
def test_other_learners_are_measured_without_yardsticks(tmp_path):
    overrides = ["track=generated", "track.train.count=1", "learner=dqn", "learner.starts=300"]
    overrides += ["learner.updates_per_step=0.125", "learner.batch_size=8"]
    main([*overrides, "--quick", "--parts", "training", "sb3", "--output", str(tmp_path / "run")])
    results = json.loads((tmp_path / "run" / "benchmark.json").read_text())
    (row,) = results["training"]
    assert {"ppo", "coil"} <= set(row["rounds"])
    assert "not measured" in results["sb3"][0]


@pytest.mark.parametrize(
    "override", ["method=rfc has no effect", "learner.gamma='x' must be a valid number"]
)
def test_mistake_is_one_sentence_and_leaves_no_folder(tmp_path, capsys, override):
    with pytest.raises(SystemExit) as end:
        main([override.split()[0].replace("'", ""), "--quick", "--output", str(tmp_path / "run")])
    assert (end.value.code, list(tmp_path.iterdir())) == (2, [])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"benchmark: {override}")
