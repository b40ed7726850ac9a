"""Which numbers a hyper-parameter may be."""

from __future__ import annotations

import math


def check_numbers(low: float, high: float = math.inf, *, above: bool = False, **numbers: float) -> None:
    """Refuse numbers outside their range.

    Args:
        low: the lowest.
        high: the highest; without one, any finite number.
        above: a number must be more than the lowest.
        numbers: by name.

    Raises:
        ValueError: for the first that is outside, or NaN, naming it.
    """
    most = f"and at most {high}" if high < math.inf else "and finite"
    for name, number in numbers.items():
        if not (low < number if above else low <= number) or number > high or math.isinf(number):
            raise ValueError(f"{name}={number} must be {'more than' if above else 'at least'} {low} {most}")
