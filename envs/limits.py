"""Ranges of arguments of more than one env."""

from typing import Annotated

from coil_rl.ranges import Interval

# Of an episode: laps, seconds, and places where it may begin.
Laps = Annotated[int, Interval(gt=0, le=10**6)]
Seconds = Annotated[float, Interval(gt=0, le=10**6)]
Starts = Annotated[int, Interval(ge=1, le=10**5)]
Kept = Annotated[int, Interval(ge=2)]  # of the visible cones of a side; a curve needs two
Degrees = Annotated[float, Interval(gt=0, le=90)]  # of the largest steering
