"""What an output is to follow: setpoints that are constant, steps, ramps, or from a file."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from coil_rl.ranges import Positive, checked

Floats = NDArray[np.float64]


@checked
@dataclass(frozen=True)
class Course:
    """The setpoint of an output over an episode, drawn anew for each from its seed.

    Args:
        low: smallest value of a draw.
        high: largest value.
        every: s, after which another value is drawn; None: one for the whole episode.
        kind: "steps", or "ramps" from one value to the next.
        file: a CSV with times (s) in the first column and a course in each other one, of which one
            is drawn; instead of `low` and `high`.

    Raises:
        ValueError: for `low` above `high`, a time that is not above 0, or a file that is none.
    """

    low: float = 0.0
    high: float = 0.0
    every: Positive | None = None
    kind: Literal["steps", "ramps"] = "steps"
    file: str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        if not float(self.low) <= float(self.high):
            raise ValueError(f"low={self.low} must be at most high={self.high}")
        if self.file is not None:
            _table(self.file)

    def drawn(self, random: np.random.Generator, seconds: float) -> "Drawn":
        """Return the course of an episode.

        Args:
            random: what draws it.
            seconds: length of the episode.
        """
        if self.file is not None:
            times, *courses = _table(self.file).T
            return Drawn(times, courses[random.integers(len(courses))], self.kind)
        count = 1 if self.every is None else int(np.ceil(seconds / self.every)) + 1
        times = np.arange(count, dtype=np.float64) * (self.every or 0.0)
        return Drawn(times, random.uniform(self.low, self.high, count), self.kind)


@dataclass(frozen=True)
class Drawn:
    """A course: values at some times, between which they are held or go straight on."""

    times: Floats
    values: Floats
    kind: str

    def at(self, time: float) -> float:
        """Return the value at a time, in s since the begin of the episode."""
        if self.kind == "ramps":
            return float(np.interp(time, self.times, self.values))
        # A step falls into the control step that it begins with, rounded or not.
        index = int(np.searchsorted(self.times, time + 1e-9, "right")) - 1
        return float(self.values[max(index, 0)])


def course_of(name: str, given: Any) -> Course:
    """Return a course for what a person gave: a number, or arguments of `Course`.

    Args:
        name: of what it is for, for the message.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(given, Course):
        return given
    try:
        return Course(**given) if isinstance(given, Mapping) else Course(float(given), float(given))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}; give a number, or {{low: 0.8, high: 1.2}}") from error


def _table(file: str | os.PathLike[str]) -> Floats:
    """Return the numbers of a CSV file, [T, 1 + courses]; its first line may hold names."""
    name = os.fspath(file)
    try:
        with open(name, encoding="utf-8") as lines:
            names = lines.readline().strip(' \n"\ufeff')[:1].isalpha()
        table = np.loadtxt(name, delimiter=",", skiprows=int(names), ndmin=2)
    except (OSError, ValueError) as error:
        raise ValueError(f"file={name} cannot be read as numbers ({error})") from error
    if table.shape[1] < 2 or not np.isfinite(table).all() or (np.diff(table[:, 0]) <= 0).any():
        raise ValueError(f"file={name} must have rising times and a column of values beside them")
    return table
