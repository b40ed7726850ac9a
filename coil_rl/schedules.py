"""Schedules: values that change over a run.

A schedule is called with the progress of the run, 0 at the start and 1 at the end, and returns a number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Schedule = Callable[[float], float]


@dataclass(frozen=True)
class Linear:
    """Linear interpolation between two values; raises a `ValueError` if `until` is out of range.

    Example:
        >>> Linear(1.0, 0.0)(0.25)
        0.75
    """

    start: float  # value at progress 0
    end: float  # value from progress `until` on
    until: float = 1.0  # progress at which `end` is reached, in (0, 1]

    def __post_init__(self) -> None:
        if not 0 < self.until <= 1:
            raise ValueError(f"until={self.until} must be more than 0 and at most 1: it is a share of the run")

    def __call__(self, progress: float) -> float:
        """Return the value at this progress."""
        return self.start + (self.end - self.start) * min(1.0, progress / self.until)


def schedule(value: float | Schedule) -> Schedule:
    """Return a schedule as it is, and a number as a constant schedule."""
    return value if callable(value) else lambda progress: value
