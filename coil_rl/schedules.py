"""Numbers that change while a run goes on: a schedule is called with the progress, 0 at the start and 1 at the end."""

from __future__ import annotations

from collections.abc import Callable

Schedule = Callable[[float], float]


class Linear:
    """From one value to another in a straight line.

    Args:
        start: value at progress 0.
        end: value from progress `until` on.
        until: progress at which `end` is reached, in (0, 1].

    Example:
        >>> Linear(1.0, 0.0)(0.25)
        0.75
    """

    def __init__(self, start: float, end: float, until: float = 1.0) -> None:
        if not 0 < until <= 1:
            raise ValueError(f"until={until} must be more than 0 and at most 1: it is a share of the run")
        self.start, self.end, self.until = start, end, until

    def __call__(self, progress: float) -> float:
        """The value at this progress."""
        return self.start + (self.end - self.start) * min(1.0, progress / self.until)


class Constant:
    """Always the same value."""

    def __init__(self, value: float) -> None:
        self.value = value

    def __call__(self, progress: float) -> float:
        """The value, whatever the progress."""
        return self.value


def schedule(value: float | Schedule) -> Schedule:
    """A schedule as it is, a number as one that never changes."""
    return value if callable(value) else Constant(value)
