"""Whether what the paper says held up here: the end of a result's page, and taken together, that of all results."""

from __future__ import annotations

import math

HEADING = "### What held up"
END = "<sub>"  # of a page: where it comes from
HELD, FAILED, OPEN = "held up", "did not hold up", "undecided"


def with_interval(value: float, low: float, high: float, spec: str = ".1f") -> str | None:
    """A number and its 95 % interval in one cell of a table; without the interval where it is NaN, None if all is."""
    if math.isnan(value):
        return None
    return f"{value:{spec}}" if math.isnan(low) else f"{value:{spec}} ({low:{spec}} to {high:{spec}})"


def verdict(value: float, low: float, high: float, spec: str = ".1f", sign: int = 1) -> str | None:
    """Whether a claim held up that a number is more than 0, in one cell of a table.

    Args:
        value: ours.
        low: where its 95 % interval begins; NaN if there is none.
        high: where it ends.
        spec: format of all three.
        sign: -1 where the claim is that it is less than 0.
    """
    number = with_interval(value, low, high, spec)
    ends = sorted((sign * low, sign * high))
    word = HELD if ends[0] > 0 else FAILED if ends[1] < 0 else OPEN
    return None if number is None else f"**{word}**: {number}"


def divide(page: str) -> tuple[str, str]:
    """A page without its end on what held up, and that end; empty if there is none."""
    before, _, after = page.partition(HEADING)
    held, _, origin = after.partition(END)
    return (f"{before}{END}{origin}", held.strip()) if held else (page, "")
