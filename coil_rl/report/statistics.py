"""Statistics of a few seeds.

These are t intervals, tests of paired differences, Holm's correction, and intervals of shares.
`scipy.stats` is imported where it is used, because that takes a second and a training run, which
needs intervals only, does without it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

SIGN_FLIP_SEEDS = 10  # five seeds have 32 sign patterns: no p below 0.06
MOST_SIGN_FLIPS = 1_000  # seeds; more patterns take gigabytes, and the t test is as good
RESAMPLES = 2**14  # sign patterns of up to 14 seeds are enumerated


class Estimate(NamedTuple):
    """Mean of a number over seeds, and what is known about it.

    Attributes:
        mean: the mean.
        low: the lower end of its 95 % t interval; NaN if unknown.
        high: the upper end.
        seeds: number of seeds.
        p: p-value of the hypothesis that the mean is 0; NaN if unknown.
    """

    mean: float
    low: float = math.nan
    high: float = math.nan
    seeds: int = 1
    p: float = math.nan

    def cell(self, spec: str) -> str | None:
        """Return mean and interval as a table cell.

        It is None if the mean is NaN, and without interval if that is NaN.
        """
        if math.isnan(self.mean):
            return None
        interval = "" if math.isnan(self.low) else f" ({self.low:{spec}} to {self.high:{spec}})"
        return f"{self.mean:{spec}}{interval}"


def mean_interval(values: ArrayLike) -> tuple[Any, Any, Any]:
    """Return the mean over seeds, and the ends of its 95 % t interval.

    Args:
        values: [seeds, ...], at least two seeds.

    Returns:
        Mean, lower end and upper end, [...] each.
    """
    from scipy.special import stdtrit  # the quantiles of t distributions

    table = np.asarray(values, dtype=np.float64)
    mean = table.mean(axis=0)
    error = table.std(axis=0, ddof=1) / np.sqrt(len(table))
    half = stdtrit(len(table) - 1, 0.975) * error
    return mean, mean - half, mean + half


def interval(values: ArrayLike) -> Estimate:
    """Return the mean of one value per seed or case with its 95 % t interval, and no p-value.

    A single value has no interval. NaN or no values give NaN.

    Args:
        values: [N].
    """
    of_each = np.asarray(values, dtype=np.float64)
    if not of_each.size or not np.isfinite(of_each).all():
        return Estimate(math.nan, seeds=len(of_each))
    if len(of_each) == 1:
        return Estimate(float(of_each[0]))
    mean, low, high = map(float, mean_interval(of_each))
    return Estimate(mean, low, high, len(of_each))


def difference(ours: ArrayLike, theirs: ArrayLike) -> Estimate:
    """Return how much more one of two has than the other for the same seeds or cases.

    Args:
        ours: [N].
        theirs: [N], in the same order.
    """
    return interval(np.subtract(ours, theirs, dtype=np.float64))


def estimate(values: ArrayLike) -> Estimate:
    """Return the mean of one value per seed, with its interval and p-value.

    From ten seeds on, p is the share of sign patterns of the values with such a mean (two-sided,
    exact up to 14 seeds); with fewer, or more than 1,000, it is that of a t test. A single seed has
    no p-value.

    Args:
        values: one value per seed, [seeds].
    """
    from scipy import stats

    found, of_seeds = interval(values), np.asarray(values, dtype=np.float64)
    if math.isnan(found.low):
        return found
    if SIGN_FLIP_SEEDS <= len(of_seeds) <= MOST_SIGN_FLIPS:
        p = stats.permutation_test(
            (of_seeds,),
            np.mean,
            permutation_type="samples",
            n_resamples=RESAMPLES,
            vectorized=True,
            rng=np.random.default_rng(0),
        ).pvalue
    elif found.high == found.mean:
        p = float(found.mean == 0)
    else:
        p = 2 * stats.t.sf(abs(found.mean) / stats.sem(of_seeds), len(of_seeds) - 1)
    return found._replace(p=float(p))


def holm(p_values: ArrayLike) -> Array:
    """Return the p-values of a family of tests after Holm's correction (1979).

    Args:
        p_values: [N], of the tests; NaN is not part of the family.
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = p.argsort()  # NaN last
    factors = np.isfinite(p).sum() - np.arange(len(p))
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(p[order] * factors).clip(max=1)
    return adjusted


def count_of_seeds(count: int, seeds: int, unit: str = "") -> str:
    """Return a number of seeds and the 95 % interval of its share as a table cell.

    Args:
        seeds: number of all seeds. The interval is that of Clopper and Pearson.
        unit: after the numbers, where other things than seeds are counted.
    """
    from scipy import stats

    interval = stats.binomtest(count, seeds).proportion_ci(method="exact")
    return f"{count} of {seeds}{unit} ({interval.low:.0%} to {interval.high:.0%})"


def wins(x: ArrayLike, y: ArrayLike) -> Array:
    """Return 1 where x scores more than y for the same seed and case, 0.5 for ties, 0 otherwise.

    Args:
        x: [seeds, cases].
        y: the same, or [1, cases] for a score shared by all seeds.
    """
    first, second = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    return (first > second) + 0.5 * (first == second)
