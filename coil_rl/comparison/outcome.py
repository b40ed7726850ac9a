"""The results of a comparison, read from its folder."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from coil_rl import record
from coil_rl.comparison.arms import GUIDE, OPPOSITE, TUNE, ZERO
from coil_rl.comparison.baselines import NAME, action_words, read_baselines
from coil_rl.comparison.entry import ZERO_ACTIONS, Entry
from coil_rl.report.curves import points
from coil_rl.report.runs import RETURN, Run, by_label, read_runs
from coil_rl.run.reasons import POLICIES, still_rising


@dataclass(frozen=True)
class Outcome:
    """Everything that was measured.

    Args:
        entries: by name, what acts without learning first.
        rows: of the table.
        runs: finished, by arm, in the order of their seeds.
    """

    entries: Mapping[str, Entry]
    rows: Sequence[dict[str, Any]]
    runs: Mapping[str, Sequence[Run]]


def read_outcome(folder: Path, arms: Sequence[str], failed: Mapping[str, str]) -> Outcome:
    """Return what was measured so far.

    Args:
        arms: names of what learns, in the order of the table.
        failed: reason by the name of a failed job.
    """
    entries: dict[str, Entry] = {}
    rows: list[dict[str, Any]] = []
    for name, table in read_baselines(folder).groupby(NAME, sort=False):
        action = action_words(table) if name == ZERO else ZERO_ACTIONS
        entries[str(name)] = Entry(str(name), table["reward"].to_numpy()[None], action=action)
        asked = int(table["steps"].sum()) if name in (GUIDE, OPPOSITE) else 0
        rows.append(_row(entries[str(name)], [table], calls=asked))
    found = read_runs([folder]) if any(folder.rglob("config.yaml")) else []
    finished = [run for run in found if run.finished]
    of_labels = by_label(sorted(finished, key=lambda run: run.seed))
    runs = {name: of_labels[name] for name in arms if name in of_labels}
    for name in arms:
        reasons = [reason for job, reason in failed.items() if job.startswith(f"{name}_seed")]
        if name not in runs:
            if reasons:
                rows.append({"policy": name, "note": f"failed: {reasons[0]}"})
            continue
        tables = [run.episodes_of(run.label) for run in runs[name]]
        returns = np.stack([table["reward"].to_numpy() for table in tables])
        rising = any(still_rising(run.curve) for run in runs[name])
        entries[name] = Entry(name, returns, rising)
        rows.append(_learned_row(entries[name], tables, runs[name], reasons))
    return Outcome(entries, rows, runs)


def _row(entry: Entry, tables: Sequence[pd.DataFrame], calls: float = 0) -> dict[str, Any]:
    """Return the row of what acts without learning."""
    return {
        "policy": entry.name,
        "return": entry.mean,
        "worst": float(entry.returns.min()),
        "failures": _failures(tables),
        "seeds": len(entry.returns) if entry.trained else None,
        "frames": 0,
        "seconds": 0.0,
        "calls": calls,
        "cases": entry.returns.shape[1],
        "note": "" if entry.action == ZERO_ACTIONS else entry.action,
    }


def _learned_row(
    entry: Entry, tables: Sequence[pd.DataFrame], runs: Sequence[Run], reasons: Sequence[str]
) -> dict[str, Any]:
    """Return the row of a trained policy in the table."""
    last = [run.curve[-1] for run in runs]
    seconds = [run.seconds for run in runs if run.seconds is not None]
    notes = [f"a seed failed: {reasons[0]}"] if reasons else []
    guides = [run.handed_over for run in runs if run.handed_over not in ("", *POLICIES)]
    if entry.name != TUNE and guides:
        notes.append(f"{len(guides)} of {len(runs)} seeds hand over the guide itself")
    if numbers := tuned_numbers(runs):
        notes.append(f"{numbers} by seed")
    if entry.rising:
        notes.append("still rising")
    firsts = [points(run.curve, RETURN)[0, 1] for run in runs if len(points(run.curve, RETURN))]
    return _row(entry, tables) | {
        "frames": float(np.mean([row["frames"] for row in last])),
        "seconds": float(np.mean(seconds)) if seconds else math.nan,
        "calls": float(np.mean([row.get("guide/calls", math.nan) for row in last])),
        "first": float(np.mean(firsts)) if firsts else math.nan,
        "note": "; ".join(notes),
    }


def tuned_numbers(runs: Sequence[Run]) -> str:
    """Return the numbers that tuning gave a guide, as a text: of each number those of all seeds.

    Args:
        runs: of one arm; nothing is returned if they tuned nothing.
    """
    read = [record.TUNED.read(run.folder) for run in runs]
    found = [numbers for numbers in read if numbers is not None]
    texts = []
    for name in found[0] if found else ():
        texts.append(f"{name} {' / '.join(f'{values[name]:.3g}' for values in found)}")
    return ", ".join(texts)


def _failures(tables: Sequence[pd.DataFrame]) -> float:
    """Return the share of failed episodes; NaN where nothing says which failed."""
    joined = pd.concat(tables)
    if "crashed" in joined:
        return float(joined["crashed"].astype(float).mean())
    if "completed" in joined:
        return float(1 - joined["completed"].astype(float).mean())
    return math.nan


def first_of(outcome: Outcome, name: str) -> Run | None:
    """Return the first run of an arm; None for what does not learn."""
    return next(iter(outcome.runs.get(name, ())), None)
