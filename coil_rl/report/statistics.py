"""Statistics of a few seeds on a few tracks: interquartile mean, bootstrap interval and probability of improvement.

After Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice" (2021).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Array = NDArray[np.float64]

BATCH = 500  # resamples at a time, to limit memory


def iqm(scores: ArrayLike, axis: int | None = None) -> Any:
    """Return the interquartile mean: the mean of the middle half of the scores, at least one.

    Quarters are cut exactly, scores at the edges in part: repeating all scores does not change the result, so the
    single evaluation of a guide compares with many seeds of an agent.

    Example:
        >>> float(iqm([0, 10, 11, 100]))
        10.5
    """
    values = np.asarray(scores, dtype=np.float64)
    if not values.size:
        raise ValueError("The interquartile mean needs at least one score; got none.")
    # Four copies: SciPy cuts off whole scores only.
    return stats.trim_mean(np.repeat(values, 4, axis=axis), 0.25, axis=axis)


def stratified_bootstrap(
    scores: ArrayLike, statistic: Callable[..., Any] = iqm, resamples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Return the 95 % interval of a statistic of all scores: percentile bootstrap over seeds.

    A resampled seed keeps its scores on all tracks: they come from one policy and are correlated, and intervals from
    independent draws per track would be far too narrow. With few seeds the interval is too narrow anyway: for five
    normally distributed ones it contains the mean in about 85 of 100 cases, for ten in 90.

    Args:
        scores: [seeds, tracks], not empty.
        statistic: of all scores; it takes an array and `axis`, as `iqm` and `numpy.mean` do.
        resamples: number of resamples.
        seed: of the resamples.

    Returns:
        Both ends of the interval; NaN for a single seed.
    """
    table = np.asarray(scores, dtype=np.float64)
    if table.ndim != 2 or not table.size:
        raise ValueError(f"scores must be a table [seeds, tracks] that is not empty; got the shape {table.shape}.")
    if len(table) == 1:
        return float("nan"), float("nan")

    def joint_statistic(*tracks: Array, axis: int) -> Any:
        return statistic(np.concatenate(tracks, axis=axis), axis=axis)

    interval = stats.bootstrap(
        tuple(table.T), joint_statistic, paired=True, vectorized=True, n_resamples=resamples,
        batch=min(BATCH, resamples), method="percentile", rng=np.random.default_rng(seed),
    ).confidence_interval  # fmt: skip
    return float(interval.low), float(interval.high)


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Return the probability that a run of x scores more than a run of y on the same track; ties count half.

    Mann-Whitney U over the number of pairs of runs, averaged over tracks. x and y are [seeds, tracks], with the same
    tracks and any seeds.
    """
    first, second = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if first.ndim != 2 or second.ndim != 2 or first.shape[1] != second.shape[1] or not first.size * second.size:
        raise ValueError(f"x and y must be [seeds, tracks] of the same tracks; got {first.shape} and {second.shape}.")
    # The p-value is not used; the asymptotic one is the cheapest.
    wins = stats.mannwhitneyu(first, second, axis=0, method="asymptotic").statistic
    return float(np.mean(wins) / (len(first) * len(second)))


def wins(x: ArrayLike, y: ArrayLike) -> Array:
    """Return 1 where x scores more than y for the same seed and track, 0.5 for ties, 0 otherwise.

    x is [seeds, tracks]; y is the same, or [1, tracks] for a score shared by all seeds.
    """
    first, second = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if first.ndim != 2 or second.ndim != 2 or second.shape not in (first.shape, (1, first.shape[1])):
        raise ValueError(f"x and y must be [seeds, tracks] of the same seeds; got {first.shape} and {second.shape}.")
    won: Array = (first > second) + 0.5 * (first == second)
    return won
