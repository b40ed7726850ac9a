"""Rows of the guide benchmark: what a method gave with one guide in one task.

A row stands for all seeds of a method and an arm that plain PPO has too. Its scores are (return -
random) / (reference - random): `random` is the return of the task's random guide, and the reference
is in references.csv, with its source. Rows of others are checked by `check_row` before they join
the table.
"""

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.promise import (
    ALONE,
    INTACT,
    PPO,
    RANDOM,
    Arm,
    Key,
    arms_of,
    fingerprint,
    guide_of,
    paired,
    rows_of_task,
    scale_of,
    verdict,
)
from coil_rl import record
from coil_rl.report.curves import learning, points
from coil_rl.report.runs import RETURN, Run

REFERENCES = Path(__file__).parent / "references.csv"
GUIDE = "guide"  # as a reference: the return of the intact guide
SEEDS = {"standard": 5, "headline": 10}
STANDARD_FRAMES = 60_000  # of the effort `standard`
ENOUGH = 0.9  # of the frames of an effort; batches are complete, so that a run may end earlier
SAME = 1e-6  # of a score that is computed again
SCORES = {"score_guide": "guide", "score_ppo": "ppo", "score": "end"}
NUMBERS = (
    *("frames", "random", "reference", "guide", "ppo", "end", *SCORES),
    *("difference", "low", "high", "first", "lowest", "frames_to_guide"),
    *("failures", "seconds", "guide_calls"),
)
KNOWN = ("frames", "random", "reference", "ppo", "end", "score_ppo", "score", "seconds")
VERSIONS = ("coil-rl", "torch", "torchrl", "gymnasium", "commit")
REACHED = "reached"  # seeds that `frames_to_guide` is the mean of; empty where it was not counted
COLUMNS = (
    *("task", "method", "arm", "effort", "seeds", *NUMBERS, REACHED, "verdict"),
    *("fingerprint", *VERSIONS),
)


@dataclass(frozen=True)
class Reference:
    """What the score 1 means in a task.

    Args:
        frames: of a full run.
        level: a return, or "guide".
        source: of the level.
    """

    frames: int
    level: str
    source: str

    def value(self, guide: float) -> float:
        """Return the reference as a number."""
        return guide if self.level == GUIDE else float(self.level)


def references() -> dict[str, Reference]:
    """Return the reference of each task."""
    with REFERENCES.open(encoding="utf-8", newline="") as file:
        return {
            row["task"]: Reference(int(row["frames"]), row["reference"], row["source"])
            for row in csv.DictReader(file)
        }


def effort(seeds: int, frames: float, reference: Reference) -> str:
    """Return "smoke", "standard" or "headline"."""
    standard = min(STANDARD_FRAMES, reference.frames)
    if seeds < SEEDS["standard"] or frames < ENOUGH * standard:
        return "smoke"
    whole = frames >= ENOUGH * reference.frames
    return "headline" if whole and seeds >= SEEDS["headline"] else "standard"


def benchmark_rows(task: str, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return the rows of a task, those with the highest end first; none without plain PPO.

    Args:
        runs: its runs; their labels are METHOD_ARM.

    Raises:
        ValueError: if the task is not in references.csv.
    """
    known = references()
    if task not in known:
        raise ValueError(f"the task {task} has no reference: add a line to {REFERENCES}")
    arms = arms_of(runs)
    if (PPO, ALONE) not in arms:
        return []
    compared = {(row["method"], row["arm"]): row for row in rows_of_task(task, arms, PPO)}
    rows = [_row(task, key, arms, compared.get(key, {}), known[task]) for key in arms]
    return sorted(rows, key=lambda row: -row["end"])


def _row(
    task: str, key: Key, arms: dict[Key, Arm], compared: Mapping[str, Any], reference: Reference
) -> dict[str, Any]:
    """Return one row; what a method without a guide does not have is NaN."""
    arm, alone = paired(arms[key], arms[PPO, ALONE])
    runs = list(arm.runs.values())
    row: dict[str, Any] = dict.fromkeys(COLUMNS, math.nan)
    row |= {name: compared[name] for name in COLUMNS if name in compared}
    row |= {
        "task": task,
        "method": key[0],
        "arm": key[1],
        "seeds": len(runs),
        "ppo": float(np.mean([alone.reward(seed) for seed in alone.runs])),
        "end": float(np.mean([arm.reward(seed) for seed in arm.runs])),
        "random": guide_of(arms, RANDOM),
        "reference": reference.value(guide_of(arms, INTACT)),
        "fingerprint": fingerprint(runs[0].settings),
        **_learning(runs),
        **_versions(runs),
    }
    scale = scale_of(arms, arms[PPO, ALONE])
    row |= {name: 100 * row[name] / scale for name in ("first", "lowest")}
    return row | derived(row, reference)


def _versions(runs: Sequence[Run]) -> dict[str, str]:
    """Return the versions of the libraries of runs; different ones are joined by a slash."""
    found = [record.VERSIONS.need(run.folder) for run in runs]
    columns = {name: dict.fromkeys(each.get(name, "") for each in found) for name in VERSIONS}
    return {name: " / ".join(filter(None, column)) for name, column in columns.items()}


def derived(row: Mapping[str, Any], reference: Reference) -> dict[str, Any]:
    """Return what follows from the other numbers of a row: its scores, effort and verdict."""
    found: dict[str, Any] = {name: score(row[of], row) for name, of in SCORES.items()}
    found["effort"] = effort(row["seeds"], row["frames"], reference)
    decided = verdict(row["difference"], row["low"], row["high"])
    return found | {"verdict": "" if row["arm"] == ALONE else decided}


def score(value: float, row: Mapping[str, Any]) -> float:
    """Return (value - random) / (reference - random).

    Args:
        row: with `random` and `reference`.
    """
    distance = float(row["reference"]) - float(row["random"])
    return (float(value) - float(row["random"])) / distance if distance else math.nan


def _learning(runs: Sequence[Run]) -> dict[str, float | None]:
    """Return the means over seeds of what learning curves and tables say."""
    measured = pd.DataFrame([_of_run(run) for run in runs])
    result: dict[str, float | None] = {**measured.mean(), "lowest": measured["lowest"].min()}
    result[REACHED] = None
    if measured["lowest"].notna().any():  # so curves and guides are known
        result[REACHED] = int(measured["frames_to_guide"].count())
    return result


def _of_run(run: Run) -> dict[str, float]:
    """Return the numbers of one run; returns of the curve's cases relative to its guide."""
    found, returns = learning(run), points(run.curve, RETURN)[:, 1].tolist()
    crashed = run.episodes_of(run.label).get("crashed")
    return {
        "frames": found["frames"],
        "guide_calls": run.curve[-1].get("guide/calls", math.nan) if run.curve else math.nan,
        "first": found["first"] - found["guide"],
        "lowest": min(returns, default=math.nan) - found["guide"],
        "frames_to_guide": found["until_guide"],
        "failures": math.nan if crashed is None else float(crashed.mean()),
        "seconds": math.nan if run.seconds is None else run.seconds,
    }


def check_row(row: Mapping[str, str]) -> dict[str, Any]:
    """Check a row as it is in the file, and return it with its cells as numbers.

    Args:
        row: its cells by column; `reached` may be missing, as in older tables.

    Raises:
        ValueError: if it is not complete, contradicts itself, or belongs to no task.
    """
    expected = tuple(name for name in COLUMNS if name != REACHED or name in row)
    if tuple(row) != expected or None in row.values():
        raise ValueError(
            f"the columns are {', '.join(map(str, row))}; expected: {', '.join(COLUMNS)}"
        )
    place = ", ".join(row[name] for name in ("task", "method", "arm"))
    known = references()
    if row["task"] not in known:
        raise ValueError(f"{place}: no such task; add it to {REFERENCES.name}")
    try:
        numbers = {name: float(row[name]) for name in NUMBERS}
        seeds, cell = int(row["seeds"]), row.get(REACHED)
        reached = int(cell) if cell else None  # None if it was not counted
    except ValueError as error:
        raise ValueError(f"{place}: a number is expected ({error})") from error
    numbered = {**row, **numbers, "seeds": seeds, REACHED: reached}
    unknown = ", ".join(name for name in KNOWN if not math.isfinite(numbers[name]))
    missing = ", ".join(name for name in VERSIONS if not row[name])
    without = math.isnan(numbers["frames_to_guide"])
    rules = [
        (unknown == "", f"{unknown} must be known; random needs its arm"),
        (
            seeds > 0 and numbers["frames"] > 0 and not any(map(math.isinf, numbers.values())),
            "seeds and frames must be above 0, and no number infinite",
        ),
        (
            reached is None or 0 <= reached <= seeds,
            f"reached={reached}, but the row has {seeds} seeds",
        ),
        (
            reached is None or (reached == 0) == without,
            f"reached={reached}, but frames_to_guide={row['frames_to_guide']}",
        ),
        (
            re.fullmatch("[0-9a-f]{10}", row["fingerprint"]),
            f"fingerprint={row['fingerprint']} is not ten hexadecimal digits",
        ),
        (missing == "", f"the versions of {missing} are missing"),
    ]
    for holds, problem in rules:
        if not holds:
            raise ValueError(f"{place}: {problem}")
    _check_derived(place, numbered, known[row["task"]])
    return {name: numbered[name] for name in COLUMNS}


def read_rows(file: Path) -> list[dict[str, Any]]:
    """Return the checked rows of a table, with numbers in place of their text.

    Raises:
        OSError: if it cannot be read.
        ValueError: if a row is not valid.
    """
    with file.open(encoding="utf-8", newline="") as table:
        return [check_row(row) for row in csv.DictReader(table)]


def _check_derived(place: str, row: Mapping[str, Any], reference: Reference) -> None:
    """Raise a `ValueError` if something does not follow from the other numbers of a row."""
    for name, expected in derived(row, reference).items():
        own = row[name]
        if isinstance(expected, str):
            follows = own == expected
        else:
            follows = np.isclose(own, expected, atol=SAME, equal_nan=True)
        if not follows:
            raise ValueError(f"{place}: {name}={own}, but its other numbers give {expected}")
    if reference.level != GUIDE and row["reference"] != float(reference.level):
        raise ValueError(f"{place}: reference={row['reference']}, expected {reference.level}")
