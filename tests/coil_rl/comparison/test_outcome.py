"""The results of a comparison: what a table says beside the returns."""

import json

from run_folders import driven, make_run

from coil_rl import record
from coil_rl.comparison.baselines import FILE
from coil_rl.comparison.outcome import read_outcome, tuned_numbers
from coil_rl.report import write_csv
from coil_rl.report.runs import Run


def run_with(folder, seed, **numbers):
    place = folder / f"tune_seed{seed}"
    place.mkdir()
    if numbers:
        (place / record.TUNED.name).write_text(json.dumps(numbers))
    return Run(place, "tune", seed, needs_guide=True, settings={})


def test_tuned_numbers_are_said_for_each_seed(tmp_path):
    runs = [run_with(tmp_path, 0, kp=74.26, ki=0.35), run_with(tmp_path, 1, kp=78.2, ki=0.0987)]
    assert tuned_numbers(runs) == "kp 74.3 / 78.2, ki 0.35 / 0.0987"


def test_runs_are_in_the_order_of_their_seeds(tmp_path):
    cases = {"a": 1.0, "b": 2.0}
    rows = [{"baseline": name, "reward": 1.0, "steps": 3} for name in ("guide", "random")]
    write_csv(rows, tmp_path / FILE)
    for seed in (9, 10):
        make_run(tmp_path / f"ppo_seed{seed}", "ppo", seed, driven("ppo", cases))
    found = read_outcome(tmp_path, ["ppo", "sac"], {})
    assert [run.seed for run in found.runs["ppo"]] == [9, 10]
    assert set(found.runs) == {"ppo"}


def test_runs_that_tune_nothing_have_no_numbers(tmp_path):
    assert tuned_numbers([run_with(tmp_path, 0), run_with(tmp_path, 1)]) == ""
