"""Bearings of the ranges of a scan, where a driver contradicts itself.

A scan has the bearing of its first range, the step to the next one, and the bearing of its last
range. Drivers give one of the three wrongly: a step for one range too many, the first and the last
one exchanged. What is taken, and why, is said in a remark.
"""

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TURN = 2 * math.pi
SLACK = 1.5  # steps, by which the last bearing may differ and still be meant
EXACT = 0.4  # of a step over the number of ranges: differs no more than by rounding


class Angles(NamedTuple):
    """Bearings as a scan gives them, or as they are taken.

    Attributes:
        first: radians, of the first range.
        last: radians, of the last range.
        step: radians, to the next range.
    """

    first: float
    last: float
    step: float


def bearings(angles: Sequence[Angles], points: NDArray[np.int64]) -> tuple[Floats, list[str]]:
    """Return the bearing of the first range and the step of each scan, and remarks.

    Scans with the same three angles are taken alike, by the most frequent number of their ranges.

    Args:
        angles: of N scans.
        points: [N], number of their ranges.

    Returns:
        [N, 2] radians, and what had to be decided.

    Raises:
        ValueError: for a scan whose ranges all have the same bearing.
    """
    counts: dict[Angles, Counter[int]] = {}
    for each, number in zip(angles, points.tolist(), strict=True):
        counts.setdefault(each, Counter())[number] += 1
    taken: dict[Angles, tuple[float, float]] = {}
    problems: Counter[str] = Counter()
    examples: dict[str, str] = {}
    for each, numbers in counts.items():
        number = numbers.most_common(1)[0][0]
        taken[each] = each.first, each.step
        if number < 2:
            continue
        decided, problem, example = _decide(each, number)
        taken[each] = decided.first, decided.step
        if problem:
            problems[problem] += numbers.total()
            examples.setdefault(problem, example)
    remarks = []
    for problem, scans in problems.items():
        remarks.append(f"{problem} in {scans} of {len(angles)} scans ({examples[problem]})")
    return np.array([taken[each] for each in angles]).reshape(-1, 2), remarks


def _decide(angles: Angles, points: int) -> tuple[Angles, str, str]:
    """Return usable angles of a scan, and the fault of the given ones with an example.

    The texts of fault and example are empty where nothing is wrong.

    Args:
        points: number of its ranges, at least 2.
    """
    span, declared = angles.step * (points - 1), angles.last - angles.first
    example = (
        f"angle_min={angles.first:.4f}, angle_max={angles.last:.4f}, "
        f"angle_increment={angles.step:.5f}, {points} ranges"
    )
    if span == 0 and (declared == 0 or not math.isfinite(declared)):
        raise ValueError("angle_increment is 0, so all its ranges have the same bearing")
    unset = _unset(angles, span)
    if abs(span) > 1.01 * TURN + abs(angles.step) and (unset or abs(declared) > 1.01 * TURN):
        turns = abs(span) / TURN
        return angles, f"has ranges over {turns:.1f} turns, so its angles mean little,", example
    if unset:
        return angles, "has no angle_max, so angle_increment is taken,", example
    difference = declared - span
    if abs(math.remainder(difference, TURN)) <= abs(angles.step) / 2:
        return angles, "", ""
    if abs(difference - angles.step) <= EXACT / points * abs(angles.step):
        return (
            angles,
            "has an angle_max one step beyond the last range, which is left out,",
            example,
        )
    if declared * span < 0 and abs(abs(declared) - abs(span)) <= SLACK * abs(angles.step):
        swapped = angles._replace(first=angles.last, last=angles.first)
        problem = (
            "has an angle_increment from angle_max to angle_min, which are taken as exchanged,"
        )
        return swapped, problem, example
    if abs(declared) > 1.01 * TURN + abs(angles.step):
        return angles, "has an angle_max that is no bearing, so angle_increment is taken,", example
    step = declared / (points - 1)
    problem = "has an angle_increment that does not lead to angle_max, which is taken instead,"
    return angles._replace(step=step), problem, example


def _unset(angles: Angles, span: float) -> bool:
    """Return whether a driver left the last bearing out: it is zero, and far from the range."""
    if not math.isfinite(angles.last):
        return True
    if angles.last != 0 or span == 0:
        return False
    share = (angles.last - angles.first) / span
    return not 0.6 < share < 1 / 0.6
