"""Guides in the evaluations of runs: which ones are the same, and which ones changed.

Every run evaluates its guides anew, in the same cases. Evaluations with equal cases and returns
have one number, so that guides are compared by sets of numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from coil_rl.report.configurations import guide_follows_seed, of_guide
from coil_rl.report.runs import GUIDE, Run, by_label
from coil_rl.report.sentences import REPORT, listed

SAME_RETURN = 1e-5  # of the range of the compared returns; the rest is rounding
MOST_SEEDS = 4  # in a part of the seeds of a label

Numbers = dict[str, dict[str, dict[int, int]]]  # of evaluations, by guide, label and seed
OfRuns = dict[tuple[str, int], int]  # numbers of the evaluations of one guide, by label and seed


def is_guide(frame: pd.DataFrame) -> pd.Series:
    """Return whether the policy of each row of an evaluation is a guide."""
    drivers = frame["driver"]
    return drivers.isin([name for name in drivers.unique() if name.split()[:1] == [GUIDE]])


def shared_guides(runs: Iterable[Run]) -> tuple[list[tuple[str, OfRuns]], list[pd.DataFrame]]:
    """Return the different guides of all labels by their names, and the different evaluations.

    Every run evaluates its guides: equal results of one guide count once, and labels share a guide
    if the results of one contain those of the other. A guide with random actions has one result per
    seed.

    Args:
        runs: finished runs, those of a label one after the other.
    """
    numbers, different = _numbered(runs)
    guides: list[tuple[str, OfRuns]] = []
    for name, of_labels in numbers.items():
        of_name: list[OfRuns] = []
        for label, of_seeds in of_labels.items():
            shared = (each for each in of_name if _share(of_seeds.values(), each.values()))
            guide = next(shared, {})
            if not guide:
                of_name.append(guide)
            guide.update({(label, seed): number for seed, number in of_seeds.items()})
        guides += [(name, guide) for guide in of_name]
    return guides, different


def of_changed_guides(runs: Sequence[Run]) -> list[str]:
    """Return a warning for each guide whose returns differ between runs that differ by their seed.

    A guide that is known to depend on the seed of the run is left out.

    Args:
        runs: finished runs; those of one label have one configuration.
    """
    found: dict[str, list[str]] = {}
    for name, of_labels in _without_seed(runs)[0].items():
        for label, of_seeds in of_labels.items():
            parts: dict[int, list[int]] = {}
            for seed in sorted(of_seeds):
                parts.setdefault(of_seeds[seed], []).append(seed)
            if len(parts) > 1:
                shown = listed((listed(each, MOST_SEEDS) for each in parts.values()), joint=" / ")
                found.setdefault(name, []).append(f"{label} seeds {shown}")
    return REPORT.said("changed_guides", guides=found)


def of_guides_of_labels(runs: Sequence[Run]) -> list[str]:
    """Return a warning for each guide that has other returns in runs of another label.

    It is about guides with one configuration in the same cases. One that is known to depend on the
    seed of the run is left out.

    Args:
        runs: finished runs; those of one label have one configuration.
    """
    numbers, different = _without_seed(runs)
    settings = {run.label: of_guide(run) for run in reversed(runs)}
    differ: dict[str, list[str]] = {}
    for name, of_labels in numbers.items():
        known: list[tuple[str, tuple[Any, list[Any]], list[int]]] = []
        for label, of_seeds in of_labels.items():
            ours = list(of_seeds.values())
            alike = settings[label], different[ours[0]]["case"].tolist()
            others = [each for each in known if each[1] == alike]
            if others and not any(_share(ours, theirs) for *_, theirs in others):
                differ.setdefault(name, []).append(f"{others[0][0]} / {label}")
            known.append((label, alike, ours))
    return REPORT.said("guides_of_labels", guides=differ)


def _without_seed(runs: Sequence[Run]) -> tuple[Numbers, list[pd.DataFrame]]:
    """Return the evaluations of the guides that do not depend on the seed, see `_numbered`."""
    of_labels = by_label(runs).values()
    kept = chain.from_iterable(each for each in of_labels if not guide_follows_seed(each))
    return _numbered(kept)


def _numbered(runs: Iterable[Run]) -> tuple[Numbers, list[pd.DataFrame]]:
    """Return the number of the evaluation of each guide, and the different evaluations."""
    numbers: Numbers = {}
    different: list[pd.DataFrame] = []
    for run in runs:
        table = run.evaluation
        for name, rows in table[is_guide(table)].groupby("driver", sort=False):
            of_name = numbers.setdefault(str(name), {})
            known = dict.fromkeys(chain.from_iterable(each.values() for each in of_name.values()))
            equal = (number for number in known if _is_same(different[number], rows))
            number = next(equal, len(different))
            if number == len(different):
                different.append(rows)
            of_name.setdefault(run.label, {})[run.seed] = number
    return numbers, different


def _share(ours: Iterable[int], theirs: Iterable[int]) -> bool:
    """Return whether the evaluations of one of two labels contain those of the other."""
    one, other = set(ours), set(theirs)
    return one <= other or other <= one


def _is_same(one: pd.DataFrame, other: pd.DataFrame) -> bool:
    """Return whether two evaluations of guides have the same cases and returns.

    The allowed difference is small beside the range of these returns, so that it fits any unit and
    any centre, and large beside what the rounding of a batch of another size makes of one guide:
    2e-6 of the range in the cone world. A single case has no range but its own return.
    """
    if one["case"].tolist() != other["case"].tolist():
        return False
    ours, theirs = one["reward"].to_numpy(float), other["reward"].to_numpy(float)
    ends = np.concatenate([ours, theirs, [0.0] if len(one) == 1 else []])
    ends = ends[np.isfinite(ends)]
    tolerance = SAME_RETURN * float(np.ptp(ends)) if ends.size else 0.0
    return np.allclose(ours, theirs, rtol=1e-7, atol=tolerance, equal_nan=True)
