"""Checks of numbers and choices among the arguments of a constructor."""

import math
from typing import Annotated

from coil_rl.ranges import Interval

LARGEST_SEED = 2**63 - 1
# Of an episode: laps, seconds, and places where it may begin.
Laps = Annotated[int, Interval(gt=0, le=10**6)]
Seconds = Annotated[float, Interval(gt=0, le=10**6)]
Starts = Annotated[int, Interval(ge=1, le=10**5)]
Degrees = Annotated[float, Interval(gt=0, le=90)]  # of the largest steering


def check_range(
    low: float, high: float = math.inf, *, above: bool = False, **values: float
) -> None:
    """Raise a `ValueError` for the first value out of range; NaN and infinity always are.

    Args:
        low: smallest allowed value.
        high: largest allowed value; infinity for none.
        above: whether `low` itself is excluded.
        values: the values to check, by the name that the message gives them.
    """
    lower = "more than" if above else "at least"
    upper = f"and at most {high}" if high < math.inf else "and finite"
    for name, value in values.items():
        large_enough = low < value if above else low <= value
        if not large_enough or value > high or math.isinf(value):
            raise ValueError(f"{name}={value} must be {lower} {low} {upper}")


def check_choice(choices: tuple[str, ...], **values: str) -> None:
    """Raise a `ValueError` for the first value that is not one of the choices.

    Args:
        values: the values to check, by the name that the message gives them.
    """
    for name, value in values.items():
        if value not in choices:
            raise ValueError(f"{name}={value!r} must be one of {', '.join(choices)}")
