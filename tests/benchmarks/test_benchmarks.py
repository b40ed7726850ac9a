import json
import time
from argparse import Namespace

import pytest

from benchmarks.__main__ import PARTS, main
from benchmarks.timing import Stopwatch, measure, median_ratio


def test_subjects_alternate_after_a_warm_up():
    calls = []

    def subject(name):
        return lambda: calls.append(name) or time.sleep(0.01) or 5

    rates = measure(Namespace(seconds=0.0, repeats=3), {"a": subject("a"), "b": subject("b")})
    assert calls == ["a", "b"] * 4
    assert all(len(rounds) == 3 and 0 < max(rounds) <= 500 for rounds in rates.values())
    # A ratio of medians would be 10 / 4: the second round was slow.
    assert median_ratio([10, 2, 20], [5, 1, 4]) == 2


def test_stopwatch_counts_the_outer_of_two_methods():
    class Work:
        def outer(self):
            time.sleep(0.02)
            return self.inner()

        def inner(self):
            time.sleep(0.02)
            return 7

    work, stopwatch = Work(), Stopwatch()
    stopwatch.wrap(work, "outer", "outer")
    stopwatch.wrap(work, "inner", "inner")
    assert work.outer() == work.inner() == 7
    assert stopwatch.seconds["outer"] >= 0.04
    assert 0.02 <= stopwatch.seconds["inner"] < 0.04


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
