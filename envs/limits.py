"""Checks of numbers and choices among the arguments of a constructor."""

import math

LARGEST_SEED = 2**63 - 1
LARGEST_COUNT = 10**6  # of laps, and of seconds or held steps of an episode
LARGEST_STARTS = 10**5  # places of a world where an episode may begin


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
