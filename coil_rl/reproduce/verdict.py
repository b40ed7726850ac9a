"""Whether what the paper says held up here: a line on the page of a result, found again by the page of all results."""

from __future__ import annotations

import math

HELD, FAILED, OPEN = "held up", "did not hold up", "undecided"


def verdict(claim: str, low: float, high: float, said: str) -> str:
    """A line on a claim of the paper that a number is more than 0: whether it held up here.

    Args:
        claim: of the paper.
        low: where the 95 % interval of the number begins; NaN if there is none.
        high: where it ends.
        said: the numbers, ours and the paper's.
    """
    word = HELD if low > 0 else FAILED if high < 0 else OPEN
    return f"- **{word}**: {claim}: {said}"


def verdicts(page: str) -> list[str]:
    """The lines of `verdict` on a page."""
    return [line for line in page.splitlines() if line.startswith(tuple(f"- **{w}**" for w in (HELD, FAILED, OPEN)))]


def interval(low: float, high: float, spec: str = ".1f") -> str | None:
    """A 95 % interval in words; None if there is none."""
    return None if math.isnan(low) else f"{low:{spec}} to {high:{spec}}"
