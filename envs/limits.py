"""Checks of numbers and choices among the arguments of a constructor."""

import math

LARGEST_SEED = 2**63 - 1
LARGEST_COUNT = 10**6  # of laps, and of seconds or held steps of an episode
LARGEST_STARTS = 10**5  # places of a world where an episode may begin


def check_range(
    low: float, high: float = math.inf, *, above: bool = False, **values: float
) -> None:
    """Raise a `ValueError` for the first value outside of [low, high], and for NaN and infinity.

    `above` excludes `low` itself.
    """
    upper = f"and at most {high}" if high < math.inf else "and finite"
    for name, value in values.items():
        if not (low < value if above else low <= value) or value > high or math.isinf(value):
            raise ValueError(
                f"{name}={value} must be {'more than' if above else 'at least'} {low} {upper}"
            )


def check_choice(choices: tuple[str, ...], **values: str) -> None:
    """Raise a `ValueError` for the first value that is not one of the choices."""
    for name, value in values.items():
        if value not in choices:
            raise ValueError(f"{name}={value!r} must be one of {', '.join(choices)}")
