"""Schedules: values that change over a run.

A schedule is called with the progress of the run, 0 at the start and 1 at the end, and returns a
number.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from coil_rl.ranges import Interval, checked

Schedule = Callable[[float], float]


@checked
@dataclass(frozen=True)
class Linear:
    """Linear interpolation between two values.

    A value of `since` or `until` that is out of range is a `ValueError`.

    Args:
        start: value up to progress `since`.
        end: value from progress `until` on.
        until: progress at which `end` is reached, in (0, 1].
        since: progress up to which the value is `start`, in [0, until]; with both equal it jumps.

    Example:
        >>> Linear(1.0, 0.0)(0.25)
        0.75
    """

    start: float
    end: float
    until: Annotated[float, Interval(gt=0, le=1)] = 1.0
    since: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.since <= self.until:
            raise ValueError(
                f"since={self.since} must be at least 0 and at most until={self.until}"
            )

    def __call__(self, progress: float) -> float:
        """Return the value at this progress."""
        if progress >= self.until:
            return self.end
        return self.start + (self.end - self.start) * max(0.0, progress - self.since) / (
            self.until - self.since or 1.0
        )


def schedule(value: float | Schedule) -> Schedule:
    """Return a schedule as it is, and a number as a constant schedule."""
    return value if callable(value) else lambda progress: value
