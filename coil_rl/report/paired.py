"""How one driver does against another, seed by seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coil_rl.report.comparison import Group
from coil_rl.report.runs import MEASURES
from coil_rl.report.statistics import stratified_bootstrap, wins


@dataclass(frozen=True)
class Paired:
    """What came of comparing.

    Attributes:
        seeds: that both have.
        difference: mean of the differences of a measure, and the ends of its 95 % interval.
        better: share of seeds and tracks with more of it, ties count half; and the ends of its 95 % interval.
    """

    seeds: int
    difference: tuple[float, float, float]
    better: tuple[float, float, float]


def paired(group: Group, other: Group, measure: str = "reward", resamples: int = 2000, seed: int = 0) -> Paired | None:
    """Compare a driver with another, or with a guide that drives alike with each seed.

    Args:
        group: the driver.
        other: the one against which.
        measure: one of MEASURES.
        resamples: of the bootstrap.
        seed: of the bootstrap.

    Returns:
        None where there is nothing to pair: other tracks, no common seed, or a measure that is not known everywhere.
    """
    if group.tracks != other.tracks:
        return None
    place = MEASURES.index(measure)
    ours, theirs = group.values[..., place], other.values[..., place]
    if other.seed_numbers:
        common = [number for number in group.seed_numbers if number in other.seed_numbers]
        ours = ours[[group.seed_numbers.index(number) for number in common]]
        theirs = theirs[[other.seed_numbers.index(number) for number in common]]
    elif len(theirs) > 1:
        return None
    if not ours.size or not np.isfinite(ours).all() or not np.isfinite(theirs).all():
        return None
    of_seeds = {"difference": ours - theirs, "better": wins(ours, theirs)}
    found = {
        name: (float(table.mean()), *stratified_bootstrap(table, np.mean, resamples=resamples, seed=seed))
        for name, table in of_seeds.items()
    }
    return Paired(len(ours), found["difference"], found["better"])
