"""The results of a comparison: what a table says beside the returns."""

import json
import math

from run_folders import driven, make_run

from coil_rl.comparison.baselines import FILE, NAME
from coil_rl.comparison.outcome import NOT_JUDGED, read_outcome, tuned_numbers
from coil_rl.report import write_csv
from coil_rl.report.runs import Run
from coil_rl.tune.run import TUNED


def run_with(folder, seed, **numbers):
    place = folder / f"tune_seed{seed}"
    place.mkdir()
    if numbers:
        (place / TUNED.name).write_text(json.dumps(numbers))
    return Run(place, "tune", seed, needs_guide=True, settings={})


def test_tuned_numbers_are_said_for_each_seed(tmp_path):
    runs = [run_with(tmp_path, 0, kp=74.26, ki=0.35), run_with(tmp_path, 1, kp=78.2, ki=0.0987)]
    assert tuned_numbers(runs) == "kp 74.3 / 78.2, ki 0.35 / 0.0987"


def test_runs_that_tune_nothing_have_no_numbers(tmp_path):
    assert tuned_numbers([run_with(tmp_path, 0), run_with(tmp_path, 1)]) == ""


def test_arm_whose_start_test_had_too_few_cases_is_not_judged(tmp_path):
    baselines = [{NAME: name, "reward": 1.0, "steps": 5} for name in ("guide", "random")]
    write_csv(baselines, tmp_path / FILE)
    for arm, cases in (("coil_anchored", 2.0), ("ppo", math.nan)):
        for seed in range(2):
            folder = tmp_path / f"{arm}_seed{seed}"
            make_run(folder, arm, seed, driven(arm, {"0": -173.0}))
            row = {"frames": 0.0, "start/cases": cases, "start/weight": float(seed)}
            write_csv([row, row | {"frames": 100.0}], folder / "metrics.csv")
    outcome = read_outcome(tmp_path, ["ppo", "coil_anchored"], {})
    assert outcome.entries["ppo"].returns.shape == (2, 1)
    assert outcome.entries["coil_anchored"].returns.shape == (1, 1), "the seed that holds it"
    assert f"1 of 2 seeds {NOT_JUDGED}" in outcome.rows[-1]["note"]
    for file in (tmp_path / "coil_anchored_seed1").iterdir():
        file.unlink()
    outcome = read_outcome(tmp_path, ["ppo", "coil_anchored"], {})
    assert "coil_anchored" not in outcome.entries
    assert outcome.rows[-1] == {"policy": "coil_anchored", "note": NOT_JUDGED}
