"""The results of what is compared, and the paired difference of two of them."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coil_rl.comparison.arms import GUIDE, NETWORK, OPPOSITE, RANDOM, TUNE, ZERO
from coil_rl.report import statistics
from coil_rl.report.statistics import Estimate
from coil_rl.report.table import return_format

Array = NDArray[np.float64]
IDLE = (ZERO, NETWORK)  # neither a guide nor trained
# What the action of `zero` is.
ZERO_ACTIONS, MIDDLE = "zero actions", "the middle of the action's range"
FIRST_CHOICE = "the first choice"


@dataclass(frozen=True)
class Entry:
    """The results of what was compared.

    Args:
        name: of the policy or arm.
        returns: [seeds, cases]; one seed for what does not learn.
        rising: whether its learning curve was still rising at the end.
        action: what the action of `zero` is, in words.
    """

    name: str
    returns: Array
    rising: bool = False
    action: str = ZERO_ACTIONS

    @property
    def mean(self) -> float:
        """Mean return over seeds and cases."""
        return float(self.returns.mean())

    @property
    def shown(self) -> str:
        """The mean as a text."""
        return format(self.mean, return_format([self.mean]))

    @property
    def learns(self) -> bool:
        """Whether it is a policy that a training learned, not a guide with tuned numbers."""
        return self.trained and self.name != TUNE

    @property
    def trained(self) -> bool:
        """Whether a training made it, of a policy or of the numbers of a guide."""
        return self.name not in (GUIDE, OPPOSITE, ZERO, RANDOM, NETWORK)


@dataclass(frozen=True)
class Difference:
    """The paired difference of two entries in the same cases.

    Args:
        of_cases: mean of all cases and seeds, and its interval over the cases.
        seeds: means of each pair of seeds.
        spec: number format of the returns.
    """

    of_cases: Estimate
    seeds: tuple[float, ...]
    spec: str

    def above(self, least: float) -> bool:
        """Return whether it is clearly above 0, and at least `least`."""
        return self.of_cases.low > 0 and min(self.seeds) > 0 and self.of_cases.mean >= least

    @property
    def one_case(self) -> bool:
        """Whether there is no interval."""
        return math.isnan(self.of_cases.low)

    def __str__(self) -> str:
        unknown = " (no interval: one case)" if self.one_case else ""
        return f"{self.of_cases.cell(f'+{self.spec}')}{unknown}"


def difference(one: Entry, other: Entry) -> Difference:
    """Return how much more one entry has than another in the same cases."""
    of_cases = statistics.difference(one.returns.mean(0), other.returns.mean(0))
    of_seeds, of_others = one.returns.mean(1), other.returns.mean(1)
    if len(of_seeds) == len(of_others):
        seeds = of_seeds - of_others
    else:
        seeds = (of_seeds[:, None] - of_others[None, :]).ravel()
    spec = return_format([one.mean, other.mean])
    return Difference(of_cases, tuple(seeds.tolist()), spec)
