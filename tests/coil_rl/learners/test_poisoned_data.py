"""Steps of a guide that is worse than what is learned: their cost with a replay buffer."""

import csv

import pytest
from programs import called

pytest.importorskip("gymnasium.envs.classic_control")
FRAMES = 8_000
SMALL = [
    "env=pendulum",
    f"budget.frames={FRAMES}",
    "budget.num_envs=4",
    "budget.steps=50",
    "evaluation.curve.points=1",
    "evaluation.curve.num_envs=1",
    "evaluation.repeats=1",
    "evaluation.gif=false",
    "logger=none",
]
SAC = ["learner.updates_per_step=1", "learner.batch_size=64"]
REVERSED = ["degrade=[adversarial]", f"method.transforms.takeover.frames={FRAMES // 2}"]


def trained(folder, *overrides):
    """Return the mean return of the trained policy over 20 cases."""
    called("train", *SMALL, *SAC, *overrides, f"hydra.run.dir={folder}", cwd=folder.parent)
    with (folder / "evaluation.csv").open(newline="") as file:
        rows = [
            row
            for row in csv.DictReader(file)
            if (row["case"], row["actions"]) == ("mean", "deterministic")
            and row["driver"] != "guide"
        ]
    return float(rows[-1]["reward"])


@pytest.mark.slow
def test_steps_of_a_reversed_guide_cost_more_than_none(tmp_path):
    """The guide fills half of the run; alone, SAC learns to swing up in this number of frames."""
    alone = trained(tmp_path / "alone", "method=ppo", "learner=sac", "learner.starts=1000")
    warm = trained(
        tmp_path / "wsrl",
        "method=wsrl",
        *REVERSED,
        "learner.critics=2",
        "learner.target_critics=null",
    )
    assert warm < alone - 100
