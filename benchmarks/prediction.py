"""What predicts whether a guide helps a learner?

    python -m benchmarks.prediction outputs/experiments/promise

The folder is that of `benchmarks.promise`. The table has a row for each task and guide. The first
two numbers are means over the seeds, in percent of the scale of the promise:

- `gain`: return with the guide minus that of the learner alone, which is to be predicted;
- `ahead`: return of the guide minus that of the learner alone after a tenth of the frames;
- `residual`: R^2 with which a network predicts the learner's action minus the guide's from the
  observation, along episodes of the learner alone that it has not seen; of the first seed. A
  residual that cannot be learned is said to be a reason to keep the guide.

Below it are the rank correlations of both with the gain. The third number that is proposed, how
much better a guide is that knows more than the policy, is 0 where guides see what policies see.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.stats import spearmanr
from torchrl.envs import ExplorationType, set_exploration_type

import coil_rl
from benchmarks.promise import ALONE, arms_of, paired, runs_of, scale_of
from coil_rl.imitation import NetworkRegressor
from coil_rl.imitation.validation import cross_validate
from coil_rl.report import markdown_table
from coil_rl.report.curves import points
from coil_rl.report.runs import RETURN, Run
from coil_rl.run.parts import TEST

EPISODES, STEPS = 20, 200
COLUMNS = {
    "task": ("task", ""),
    "guide": ("guide", ""),
    "gain": ("gain (%)", "+.1f"),
    "ahead": ("ahead (%)", "+.1f"),
    "residual": ("residual (R^2)", ".2f"),
}


def after_a_tenth(run: Run) -> float:
    """Return the evaluation curve of a run after a tenth of its frames."""
    curve = points(run.curve, RETURN)
    return float(np.interp(0.1 * curve[-1, 0], curve[:, 0], curve[:, 1]))


def learnability(alone: Run, advised: Run) -> float:
    """Return R^2 with which a network predicts a policy's action minus a guide's.

    Args:
        alone: of the policy.
        advised: a run with the guide, in the same env.
    """
    learned, guided = (
        coil_rl.open_run(run.folder, trust=["benchmarks"]) for run in (alone, advised)
    )
    env = guided.make_env.around(guided.make_env.bare(EPISODES, TEST, None)).eval()
    policy = learned.policy(env, "last")
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        data = env.rollout(STEPS, policy, break_when_any_done=False)
    difference = data["action"] - data["guide_action"][..., 0, :]
    episodes = torch.arange(EPISODES).unsqueeze(1).expand(data.shape)
    x, y = data["observation"].flatten(0, 1), difference.flatten(0, 1)
    found = cross_validate(NetworkRegressor(epochs=20), x, y, episodes.flatten())
    return found["r2_by_track"]


def rows_of_task(
    name: str, runs: Sequence[Run], method: str, learner: str
) -> list[dict[str, object]]:
    """Return a row for each guide of a task."""
    arms = arms_of(runs)
    scale = scale_of(arms, arms[learner, ALONE]) / 100
    rows: list[dict[str, object]] = []
    for (label, kind), every in arms.items():
        if label != method:
            continue
        arm, alone = paired(every, arms[learner, ALONE])
        seeds = list(arm.runs)
        early = np.mean([after_a_tenth(alone.runs[seed]) for seed in seeds])
        gain = np.mean([arm.reward(seed) - alone.reward(seed) for seed in seeds])
        residual = learnability(alone.runs[seeds[0]], arm.runs[seeds[0]])
        row: dict[str, object] = {"task": name, "guide": kind, "gain": gain / scale}
        rows.append(row | {"ahead": (arm.guide - early) / scale, "residual": residual})
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table and the correlations."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="with a folder of runs for each task")
    parser.add_argument("--method", default="coil_anchored_sac", help="with guides")
    parser.add_argument("--learner", default="sac", help="alone")
    args = parser.parse_args(argv)
    rows = []
    for name, runs in runs_of(args.folder).items():
        rows += rows_of_task(name, runs, args.method, args.learner)
    print(markdown_table(rows, COLUMNS))
    for name in ("ahead", "residual"):
        found = spearmanr([row[name] for row in rows], [row["gain"] for row in rows])
        print(f"{name}: rank correlation {found.statistic:+.2f}, p {found.pvalue:.2f}")


if __name__ == "__main__":
    main()
