"""A replay in numbers: a table of policies with how far they disagree, and everything over time."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from coil_rl.replay.open_loop import OpenLoop
from coil_rl.report import markdown_table

NOTES = """
Actions are fractions of {largest:.0f} degrees. smoothness: mean |a - mean of the last 20 actions|. omega: mean |omega|.
from X: how far they disagree, mean |a - x|. Nobody steered here: each policy was asked after every scan what it would
do, in a drive that went another way. recorded is what the robot was told, as the action by which it turns as fast."""


def describe(found: OpenLoop) -> str:
    """A section of Markdown about one recording."""
    rows = [_row(found, policy) for policy in found.steering]
    columns = {"policy": ("policy", ""), "smoothness": ("smoothness", ".3f"), "omega": ("omega (rad/s)", ".3f")}
    if len(rows) > 1:
        columns |= {f"from {other}": (f"from {other}", ".3f") for other in found.steering}
    simulated = " (simulated)" if found.recording.simulated else ""
    return f"## {found.recording.path}{simulated}\n\n{extent(found)}.\n\n{markdown_table(rows, columns)}"


def extent(found: OpenLoop) -> str:
    """How many scans there are, over which time, and in how many both boundaries were in sight."""
    scans, seconds = len(found.sighted), found.recording.seconds[-1]
    cut = ", all that can be read of a file that is cut off" if found.recording.cut_off else ""
    return f"{scans} scans in {seconds:.1f} s{cut}; both boundaries valid in {found.sighted.mean():.0%} of them"


def notes(largest: float) -> str:
    """How to read the tables; `largest` in radians."""
    return NOTES.format(largest=np.degrees(largest))


def disagreement(found: OpenLoop, one: str, other: str) -> float:
    """Mean |a - b| over the scans for which both are known; NaN if there is none."""
    apart = np.abs(found.steering[one].action - found.steering[other].action)
    return _mean_of_known(apart)


def farthest(found: OpenLoop) -> tuple[float, str, str] | None:
    """Who disagree most, and by how much; None of fewer than two."""
    pairs = ((disagreement(found, one, other), one, other) for one, other in combinations(found.steering, 2))
    return max((pair for pair in pairs if not np.isnan(pair[0])), default=None, key=lambda pair: pair[0])


def over_time(found: OpenLoop) -> list[dict[str, Any]]:
    """A row a scan: its time (s), whether both boundaries were in sight, and the actions and omegas (radians/s)."""
    columns = {
        f"{policy}/{name}": values
        for policy, steering in found.steering.items()
        for name, values in (("steering", steering.action), ("omega", steering.omega))
    }
    return [
        {"time": time, "valid": int(found.sighted[scan])} | {key: values[scan] for key, values in columns.items()}
        for scan, time in enumerate(found.recording.seconds)
    ]


def _row(found: OpenLoop, policy: str) -> dict[str, Any]:
    steering = found.steering[policy]
    own = {"smoothness": _mean_of_known(steering.smoothness), "omega": _mean_of_known(np.abs(steering.omega))}
    others = {f"from {other}": disagreement(found, policy, other) for other in found.steering if other != policy}
    return {"policy": policy} | own | others


def _mean_of_known(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")
