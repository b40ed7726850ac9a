"""The promise of anchored COIL, arm by arm: at least the better of its guide and learning alone.

`coil-train +experiment=promise` trains the runs, and this program makes the table of them:

    python -m benchmarks.promise outputs/experiments/promise

A task has a folder with the runs of its arms, whose labels are METHOD_ARM. `ppo_alone` is plain
PPO, `sac_alone` plain SAC; in the others a method has an intact, detuned, reversed or random guide.
The unit is the seed. A method is compared with the better of its guide, as it acts alone in the
cases of the table, and of the learner that is best alone, seed by seed. It is a loss if the 95 %
interval of the mean difference is below 0 and the mean below -1 % of the scale, a gain if both are
above, and else even; without an interval, as with one seed, it is unknown. The scale of a task is
the distance from the return of its random guide to the better of learning alone and its intact
guide.

With `--others 10` the seeds from 10 on, which were run once afterwards, have a column of their own
beside those below 10; the other columns are of all.
"""

import argparse
import hashlib
import json
import math
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.errors import UserError
from coil_rl.files import write_text
from coil_rl.report import markdown_table, write_csv
from coil_rl.report.configurations import differing
from coil_rl.report.curves import points
from coil_rl.report.guides import is_guide
from coil_rl.report.runs import RETURN, Run, read_runs
from coil_rl.report.statistics import difference

PPO, ALONE, INTACT, RANDOM = "ppo", "alone", "intact", "random"
Key = tuple[str, str]  # method and arm
MATERIAL = 0.01  # of the scale of a task
VARIES = ("seed", "run_dir", "logger", "existing", "trust", "defaults", "workers")
COLUMNS = {
    "task": ("task", ""),
    "method": ("method", ""),
    "arm": ("arm", ""),
    "seeds": ("seeds", "d"),
    "guide": ("guide", ".1f"),
    "alone": ("alone", ".1f"),
    "learner": ("which", ""),
    "end": ("end", ".1f"),
    "difference": ("difference (%)", "+.1f"),
    "low": ("low", "+.1f"),
    "high": ("high", "+.1f"),
    "verdict": ("verdict", ""),
    "claimed": ("seeds that claim", ""),
    "others": ("others", ""),
    "lowest": ("lowest kept - guide (%)", "+.1f"),
    "tests": ("tests (% of frames)", ".1f"),
    "held": ("weight: seeds", ""),
    "handed_over": ("handed over: seeds", ""),
    "time": ("seconds / alone", ".2f"),
}


@dataclass(frozen=True)
class Arm:
    """The runs of one arm of a task, by their seeds.

    Args:
        runs: finished runs by seed.
    """

    runs: dict[int, Run]

    def reward(self, seed: int) -> float:
        """Return the mean reward of the policy that a run handed over, see `mean_reward`."""
        return mean_reward(self.runs[seed], self.runs[seed].label)

    @property
    def guide(self) -> float:
        """Mean reward of the guide alone, of the best one of several; NaN without one."""
        runs = list(self.runs.values())
        drivers = [run.evaluation["driver"][is_guide(run.evaluation)] for run in runs]
        names = dict.fromkeys(chain.from_iterable(drivers))
        return max(
            (float(np.mean([mean_reward(run, name) for run in runs])) for name in names),
            default=math.nan,
        )


def mean_reward(run: Run, driver: str) -> float:
    """Return the mean reward of a policy; NaN if there is no such policy.

    Raises:
        ValueError: if the reward of an episode is NaN.
    """
    rewards = run.episodes_of(driver)["reward"]
    if unknown := int(rewards.isna().sum()):
        raise ValueError(
            f"{run.folder}: the reward of {driver} is nan in {unknown} of {len(rewards)} cases of "
            "evaluation.csv; find out why, or remove the run from the folder"
        )
    return float(rewards.mean())


def arms_of(runs: Sequence[Run]) -> dict[Key, Arm]:
    """Return the finished runs by method and arm, the two parts of their labels.

    Raises:
        UserError: if the runs cannot be compared: for two of one arm and seed, for different
            configurations in one arm, and for different cases.
    """
    arms: dict[Key, Arm] = {}
    finished = [run for run in runs if run.finished]
    for run in finished:
        method, _, name = run.label.rpartition("_")
        arm = arms.setdefault((method, name), Arm({}))
        if run.seed in arm.runs:
            raise UserError(
                f"{run.folder} and {arm.runs[run.seed].folder} are both {run.label} with seed "
                f"{run.seed}; remove one of them from the folder"
            )
        arm.runs[run.seed] = run
    for run in finished:
        if _cases(run) != _cases(finished[0]):
            raise UserError(
                f"{run.folder} has other cases than {finished[0].folder}; train the runs of a task "
                "with the same cases, or remove those with others from the folder"
            )
    for arm in arms.values():
        own = list(arm.runs.values())
        if keys := differing(own):
            raise UserError(
                f"the runs of {own[0].label} in {own[0].folder.parent} differ in "
                f"{', '.join(keys[:3])}; keep those of one configuration in the folder"
            )
    return arms


def _cases(run: Run) -> set[str]:
    """Return the cases in which the policy of a run was evaluated."""
    return set(run.episodes_of(run.label)["case"])


def paired(arm: Arm, alone: Arm) -> tuple[Arm, Arm]:
    """Return the runs of a method and of learning alone, limited to the seeds that both have.

    Raises:
        UserError: if they have no seed in common.
    """
    seeds = sorted(set(arm.runs) & set(alone.runs))
    if not seeds:
        (one, other) = (next(iter(each.runs.values())) for each in (arm, alone))
        raise UserError(
            f"{one.folder.parent}: {one.label} has no seed of {other.label}; train both with the "
            "same seeds"
        )
    return Arm({s: arm.runs[s] for s in seeds}), Arm({s: alone.runs[s] for s in seeds})


def fingerprint(settings: Mapping[str, Any]) -> str:
    """Return ten hexadecimal digits of a configuration, the same for all seeds."""
    text = json.dumps(_without_seeds(settings), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def _without_seeds(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _without_seeds(each) for key, each in value.items() if key not in VARIES}
    return [_without_seeds(each) for each in value] if isinstance(value, list) else value


def best_alone(arms: Mapping[Key, Arm]) -> str:
    """Return the learner whose runs without a guide have the highest mean reward."""
    means = {
        learner: np.mean([each.reward(seed) for seed in each.runs])
        for (learner, arm), each in arms.items()
        if arm == ALONE
    }
    return max(means, key=lambda learner: means[learner])


def rows_of_task(
    name: str, arms: Mapping[Key, Arm], learner: str, parts: Mapping[str, range] | None = None
) -> list[dict[str, object]]:
    """Return a row of the table for each method with each guide.

    Args:
        arms: see `arms_of`.
        learner: what they are compared with, see `best_alone`.
        parts: seeds whose difference has a column of its own, by its name.
    """
    alone = arms[learner, ALONE]
    scale = scale_of(arms, alone)
    rows: list[dict[str, object]] = []
    for (method, arm), each in arms.items():
        if arm != ALONE:
            row = {"task": name, "method": method, "arm": arm, "learner": learner}
            of_parts = {
                title: _part(each, alone, scale, seeds) for title, seeds in (parts or {}).items()
            }
            rows.append(row | _row(each, alone, scale) | of_parts)
    return rows


def _part(arm: Arm, alone: Arm, scale: float, seeds: range) -> str:
    """Return the difference of some seeds of an arm, its interval and the verdict as a text."""
    part, other = (
        Arm({seed: run for seed, run in each.runs.items() if seed in seeds})
        for each in (arm, alone)
    )
    if not set(part.runs) & set(other.runs):
        return ""
    row: dict[str, Any] = _row(part, other, scale)
    interval = f"({row['low']:+.1f} to {row['high']:+.1f})"
    return f"{row['difference']:+.1f} {interval} {row['verdict']}"


def scale_of(arms: Mapping[Key, Arm], alone: Arm) -> float:
    """Return the scale of a task; NaN without a random guide, or if it is as good as the better."""
    best = float(np.mean([alone.reward(seed) for seed in alone.runs]))
    intact = guide_of(arms, INTACT)
    if not math.isnan(intact):
        best = max(best, intact)
    return abs(best - guide_of(arms, RANDOM)) or math.nan


def guide_of(arms: Mapping[Key, Arm], name: str) -> float:
    """Return the mean reward of the guide of an arm, which is no method's; NaN without the arm."""
    known = [each.guide for (_, arm), each in arms.items() if arm == name]
    return float(np.mean(known)) if known else math.nan


def _row(arm: Arm, alone: Arm, scale: float) -> dict[str, object]:
    """Return the row of a method with one guide, of the seeds that learning alone has too."""
    arm, alone = paired(arm, alone)
    seeds = list(arm.runs)
    ends = np.array([arm.reward(seed) for seed in seeds])
    better = np.array([alone.reward(seed) for seed in seeds])
    learned = float(better.mean())
    guide = arm.guide
    if guide > learned:
        better = np.full(len(seeds), guide)
    mean, low, high = (100 * each / scale for each in difference(ends, better)[:3])
    curves = [arm.runs[seed].curve for seed in seeds if arm.runs[seed].curve]
    lowest = [_lowest(arm.runs[seed]) for seed in seeds]
    held = [each for each in lowest if not math.isnan(each)]  # their number is in the column `held`
    seconds = [(arm.runs[seed].seconds, alone.runs[seed].seconds) for seed in seeds]
    tests = [rows[-1].get("frames/tests", 0.0) / rows[-1]["frames"] for rows in curves]
    return {
        "seeds": len(seeds),
        "guide": guide,
        "alone": learned,
        "end": float(ends.mean()),
        "difference": mean,
        "low": low,
        "high": high,
        "verdict": verdict(mean, low, high),
        "lowest": 100 * min(held, default=math.nan) / scale,
        "tests": 100 * max(tests, default=math.nan),
        "held": _counted(f"{rows[0].get('start/weight', math.nan):g}" for rows in curves),
        "handed_over": _counted(arm.runs[seed].handed_over for seed in seeds),
        "time": float(np.median([a / b for a, b in seconds if a and b] or [math.nan])),
    }


def rows_of_runs(name: str, arms: Mapping[Key, Arm]) -> list[dict[str, object]]:
    """Return a row for each finished run of a task."""
    rows: list[dict[str, object]] = []
    for (method, kind), arm in arms.items():
        for seed, run in sorted(arm.runs.items()):
            frames = run.curve[-1]["frames"] if run.curve else math.nan
            row = {
                "task": name,
                "method": method,
                "arm": kind,
                "seed": seed,
                "frames": frames,
                "seconds": run.seconds,
                "guide": arm.guide,
                "end": arm.reward(seed),
                "handed_over": run.handed_over,
                "fingerprint": fingerprint(run.settings),
            }
            rows.append(row)
    return rows


def verdict(mean: float, low: float, high: float) -> str:
    """Return "gain", "even", "loss" or "unknown" for a mean difference and its interval.

    Args:
        mean: in % of the scale.
        low, high: ends of its interval; NaN if it has none, as with one seed or without a scale.
    """
    if any(map(math.isnan, (mean, low, high))):
        return "unknown"
    if high < 0 and mean < -100 * MATERIAL:
        return "loss"
    if low > 0 and mean > 100 * MATERIAL:
        return "gain"
    return "even"


def counted_verdicts(verdicts: Iterable[object]) -> str:
    """Return how many verdicts there are of each kind, unknown ones only if there are any.

    Args:
        verdicts: see `verdict`.
    """
    counts = Counter(verdicts)
    unknown = f"{counts['unknown']} unknown, " if counts["unknown"] else ""
    return (
        f"{counts['gain']} gains, {counts['even']} even (undecided), {unknown}"
        f"{counts['loss']} losses"
    )


def _lowest(run: Run) -> float:
    """Return the lowest return of a kept policy minus that of the guide, in the curve's cases.

    NaN if no guide was held.
    """
    if not run.curve or not run.curve[0].get("start/weight", 0):
        return math.nan
    return float(points(run.curve, RETURN)[:, 1].min()) - max(run.guide_returns.values())


def _counted(values: object) -> str:
    """Return values with the number of times that each occurs."""
    counts = Counter(values)  # type: ignore[call-overload]
    return ", ".join(f"{value}: {count}" for value, count in counts.most_common())


def runs_of(folder: Path, pages: Path | None = None) -> dict[str, list[Run]]:
    """Return the runs of each task.

    Args:
        pages: a folder in it that is no task.

    Raises:
        UserError: if a folder has no runs, or a damaged one.
    """
    tasks = [path for path in sorted(folder.iterdir()) if path.is_dir() and path != pages]
    return {path.name: read_runs([path]) for path in tasks if not path.name.startswith(".")}


def with_ppo(folder: Path, runs: Mapping[str, list[Run]]) -> dict[str, list[Run]]:
    """Return the runs of the tasks that have plain PPO, and say which tasks are left out.

    Raises:
        ValueError: if no task has a finished run of plain PPO.
    """
    found = {task: own for task, own in runs.items() if (PPO, ALONE) in arms_of(own)}
    if not found:
        raise ValueError(f"{folder} has no task with plain PPO; train it: +arm=alone method=ppo")
    for task in runs:
        if task not in found:
            print(f"{task} is left out: it has no plain PPO; train +arm=alone method=ppo")
    return found


def main() -> None:
    """Print the table and write it into the folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of coil-train +experiment=promise")
    parser.add_argument("--others", type=int, help="smallest of the seeds that confirm the claim")
    given = parser.parse_args()
    folder = given.folder
    if not folder.is_dir():
        parser.error(f"{folder} does not exist; give the folder of the experiments")
    try:
        rows, runs = _all_rows(folder, given.others)
    except (ValueError, UserError) as error:
        parser.error(str(error))
    losses = [f"{row['task']} {row['arm']}" for row in rows if row["verdict"] == "loss"]
    sentence = counted_verdicts(row["verdict"] for row in rows)
    if losses:
        sentence += f": {', '.join(losses)}"
    columns = {name: COLUMNS[name] for name in COLUMNS if name in rows[0]}
    page = f"{markdown_table(rows, columns)}\n\n{sentence}."
    write_text(folder / "promise.md", page)
    write_csv(rows, folder / "promise.csv")
    write_csv(runs, folder / "promise_runs.csv")
    print(page)


def _all_rows(
    folder: Path, others: int | None
) -> tuple[list[dict[str, Any]], list[dict[str, object]]]:
    """Return the rows of the arms of all tasks, and those of all runs.

    Args:
        others: smallest of the seeds that confirm the claim, which have a column of their own.
    """
    rows: list[dict[str, Any]] = []
    each: list[dict[str, object]] = []
    parts = {}
    if others is not None:
        parts = {"claimed": range(others), "others": range(others, sys.maxsize)}
    for task, runs in with_ppo(folder, runs_of(folder)).items():
        arms = arms_of(runs)
        rows += rows_of_task(task, arms, best_alone(arms), parts)
        each += rows_of_runs(task, arms)
    if not rows:
        raise ValueError(f"{folder} has no run with a guide; train it: +arm=intact,random")
    return rows, each


if __name__ == "__main__":
    main()
