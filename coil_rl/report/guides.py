"""Guides in the evaluations of runs: which ones are the same, and which ones changed.

Every run evaluates its guides anew, in the same cases.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from coil_rl.report.configurations import guide_follows_seed, of_guide
from coil_rl.report.runs import GUIDE, Run
from coil_rl.report.sentences import REPORT, listed
from coil_rl.report.statistics import Array

if TYPE_CHECKING:
    import pandas as pd

SAME_RETURN = 1e-5  # of the range of the compared returns; the rest is rounding
LABELS_IN_NAME = 2  # of a guide, if there are several guides of one name
MOST_SEEDS = 4  # in a part


@dataclass(frozen=True, eq=False)
class Guide:
    """A guide that some labels share.

    Attributes:
        name: "guide", or "guide NAME".
        labels: which share the guide.
        results: the different evaluations of the guide.
        of_runs: the evaluation of each run, by label and seed.
    """

    name: str
    labels: list[str] = field(default_factory=list)
    results: list[pd.DataFrame] = field(default_factory=list)
    of_runs: dict[tuple[str, int], pd.DataFrame] = field(default_factory=dict)

    def add(self, label: str, of_seeds: Mapping[int, pd.DataFrame]) -> None:
        """Let a label share the guide.

        Args:
            label: of the runs.
            of_seeds: the evaluation in each of them by seed.
        """
        self.labels.append(label)
        self.results[:] = _different([*self.results, *of_seeds.values()])
        self.of_runs.update({(label, seed): rows for seed, rows in of_seeds.items()})

    def numbers(self) -> dict[tuple[str, int], int]:
        """Return the number of the evaluation of each run, by label and seed."""
        return {run: _position(self.results, rows) for run, rows in self.of_runs.items()}

    def listed(self) -> str:
        """Return the labels as a text, the first ones of many."""
        return listed(self.labels, LABELS_IN_NAME)

    def rows(self) -> pd.DataFrame:
        """Return all different evaluations, numbered by the column `seed`."""
        import pandas as pd

        return pd.concat([rows.assign(seed=number) for number, rows in enumerate(self.results)])


def is_guide(frame: pd.DataFrame) -> pd.Series:
    """Return whether the policy of each row of an evaluation is a guide.

    Args:
        frame: the evaluation.
    """
    return frame["driver"].str.split().str[0] == GUIDE


def shared_guides(labels: Mapping[str, pd.DataFrame]) -> list[Guide]:
    """Return the different guides of all labels.

    Every run evaluates its guides: equal results of one guide count once, and labels share a guide
    if the results of one contain those of the other. A guide with random actions has one result per
    seed.

    Args:
        labels: the evaluations by label.
    """
    guides: list[Guide] = []
    for label, frame in labels.items():
        for name, rows in frame[is_guide(frame)].groupby("driver", sort=False):
            of_seeds = dict(iter(rows.groupby("seed", sort=False)))
            same = _same_guide(guides, name, list(of_seeds.values()))
            if same is None:
                same = Guide(name)
                guides.append(same)
            same.add(label, of_seeds)
    return guides


def of_changed_guides(runs: Sequence[Run]) -> list[str]:
    """Return a warning for each guide whose returns differ between runs that differ by their seed.

    A guide that is known to depend on the seed of the run is left out.

    Args:
        runs: finished runs; those of one label have one configuration.
    """
    found: dict[str, list[str]] = {}
    for run, name, of_seeds in _guides_without_seed(runs):
        parts = _alike(of_seeds)
        if len(parts) > 1:
            shown = listed((listed(seeds, MOST_SEEDS) for seeds in parts), joint=" / ")
            found.setdefault(name, []).append(f"{run.label} seeds {shown}")
    return REPORT.said("changed_guides", guides=found)


def of_guides_of_labels(runs: Sequence[Run]) -> list[str]:
    """Return a warning for each guide that has other returns in runs of another label.

    It is about guides with one configuration in the same cases. One that is known to depend on the
    seed of the run is left out.

    Args:
        runs: finished runs; those of one label have one configuration.
    """
    first: dict[str, list[tuple[str, dict[str, Any], list[pd.DataFrame]]]] = {}
    differ: dict[str, list[str]] = {}
    for run, name, of_seeds in _guides_without_seed(runs):
        settings, results = of_guide(run), _different(of_seeds.values())
        known = first.setdefault(name, [])
        others = [each for each in known if each[1] == settings and _in_same(results, each[2])]
        if others and not any(_share(results, theirs) for _, _, theirs in others):
            differ.setdefault(name, []).append(f"{others[0][0]} / {run.label}")
        known.append((run.label, settings, results))
    return REPORT.said("guides_of_labels", guides=differ)


def _guides_without_seed(
    runs: Sequence[Run],
) -> Iterator[tuple[Run, str, dict[int, pd.DataFrame]]]:
    """Yield each guide of each label that does not depend on the seed of the run.

    With its name come the first run of the label, and the guide's evaluations by seed.
    """
    for label in dict.fromkeys(run.label for run in runs):
        of_label = [run for run in runs if run.label == label]
        if not guide_follows_seed(of_label):
            for name, of_seeds in _by_seed(of_label).items():
                yield of_label[0], name, of_seeds


def _in_same(results: Sequence[pd.DataFrame], others: Sequence[pd.DataFrame]) -> bool:
    """Return whether evaluations of two labels are in the same cases."""
    return results[0]["case"].tolist() == others[0]["case"].tolist()


def _share(results: Sequence[pd.DataFrame], others: Sequence[pd.DataFrame]) -> bool:
    """Return whether the evaluations of one of two labels contain those of the other."""
    pairs = ((results, others), (others, results))
    return any(all(_contains(ours, each) for each in theirs) for theirs, ours in pairs)


def _by_seed(runs: Sequence[Run]) -> dict[str, dict[int, pd.DataFrame]]:
    """Return the evaluations of each guide by the seed of the run."""
    of_guides: dict[str, dict[int, pd.DataFrame]] = {}
    for run in runs:
        guides = run.evaluation[is_guide(run.evaluation)]
        for name, rows in guides.groupby("driver", sort=False):
            of_guides.setdefault(str(name), {})[run.seed] = rows
    return of_guides


def _alike(of_seeds: Mapping[int, pd.DataFrame]) -> list[list[int]]:
    """Return the seeds with equal evaluations together.

    Args:
        of_seeds: the evaluation of each seed.
    """
    results = _different(of_seeds.values())
    parts: list[list[int]] = [[] for _ in results]
    for seed in sorted(of_seeds):
        parts[_position(results, of_seeds[seed])].append(seed)
    return sorted(parts)


def _different(results: Iterable[pd.DataFrame]) -> list[pd.DataFrame]:
    """Return evaluations without duplicates."""
    different: list[pd.DataFrame] = []
    for result in results:
        if not _contains(different, result):
            different.append(result)
    return different


def _contains(results: Sequence[pd.DataFrame], result: pd.DataFrame) -> bool:
    """Return whether one of several evaluations has the cases and returns of another one."""
    return _position(results, result) < len(results)


def _position(results: Sequence[pd.DataFrame], result: pd.DataFrame) -> int:
    """Return the first of several evaluations that is equal to another one; without, their number.

    Equal are the cases and the returns.
    """
    cases, returns = result["case"].tolist(), result["reward"].to_numpy(float)
    for number, other in enumerate(results):
        if other["case"].tolist() == cases and _same_returns(
            other["reward"].to_numpy(float), returns
        ):
            return number
    return len(results)


def _same_returns(one: Array, other: Array) -> bool:
    """Return whether two evaluations of guides in the same cases have the same returns.

    The allowed difference is small beside the range of these returns, so that it fits any unit and
    any centre, and large beside what the rounding of a batch of another size makes of one guide:
    2e-6 of the range in the cone world. A single case has no range but its own return.
    """
    both = np.concatenate([one, other, [0.0]]) if len(one) == 1 else np.concatenate([one, other])
    both = both[np.isfinite(both)]
    tolerance = SAME_RETURN * float(np.ptp(both)) if both.size else 0.0
    return np.allclose(one, other, rtol=1e-7, atol=tolerance, equal_nan=True)


def _same_guide(
    guides: Sequence[Guide], name: str, results: Sequence[pd.DataFrame]
) -> Guide | None:
    """Return the first guide with a name whose results contain the given ones, or the reverse."""
    for guide in guides:
        if guide.name == name and _share(results, guide.results):
            return guide
    return None
