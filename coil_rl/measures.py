"""What is measured in an episode besides its return: definitions, and means over episodes."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import compress
from statistics import fmean
from typing import Any

from coil_rl.errors import UserError, did_you_mean

MEAN_CASE = "mean"  # in the column `case`: the means over the cases
# Reductions of the steps of an episode to one number.
REDUCTIONS = ("mean", "sum", "min", "max", "last", "any", "count", "mean_nonzero")
# Columns that evaluation.csv and episodes.csv have besides the measures.
TAKEN = ("driver", "advice", "actions", "case", "reward", "steps", "episodes", "seed")
EPISODES = "_episodes"  # suffix of the columns of `with_denominators`
TYPES = {"at_least": float, "at_most": float, "reduction": str, "title": str, "format": str}
FORMAT = r"[+,]?\d{0,2}(\.\d)?[efg%]?"  # of numbers; its width has at most two digits


@dataclass(frozen=True)
class Measure:
    """A measure of an episode: an entry of the env, reduced over the steps.

    Two measures have a meaning in reports: `completed`, the success that drivers are ordered by
    first, and `crashed`, the failure that is counted by seed.

    Args:
        entry: key of one number a row, after a step; those of several agents are summed.
        reduction: of the numbers of the steps: their `mean`, `sum`, `min`, `max`, the `last` one;
            whether `any` is not 0, their `count`, or the mean of those that are not 0
            (`mean_nonzero`). Without a number, a mean is NaN. A NaN in a step makes means and sums
            NaN, but in `info` it is a number without a value, and its step does not count; for the
            others it is no number.
        where: key of a flag; only the steps with it count. A number, such as one of `info`, is set
            where it is neither 0 nor NaN.
        at_least: makes the measure a flag: whether the number is at least this. An episode without
            a number is within no bound; a mean or sum of steps with a NaN is undecided, NaN.
        at_most: makes the measure a flag: whether the number is at most this.
        title: heading of its column; None: its name; empty: it is in the CSV files only.
        format: of its numbers in tables; "auto": as they need.

    Raises:
        ValueError: for another reduction or format, two bounds, or one of a flag.
    """

    entry: str | tuple[str, ...]
    reduction: str = "mean"
    where: str | tuple[str, ...] | None = None
    at_least: float | None = None
    at_most: float | None = None
    title: str | None = None
    format: str = "auto"

    def __post_init__(self) -> None:
        if self.reduction not in REDUCTIONS:
            raise ValueError(f"reduction={self.reduction} must be one of {', '.join(REDUCTIONS)}")
        if self.at_least is not None and self.at_most is not None:
            raise ValueError("at_least and at_most cannot both be given; give one")
        if self.reduction == "any" and (self.at_least, self.at_most) != (None, None):
            raise ValueError(
                "reduction=any is a flag without bounds; write max with at_least, min with at_most"
            )
        if self.format != "auto" and not re.fullmatch(FORMAT, self.format):
            raise ValueError(f"format={self.format} must be a format of numbers, such as .1f")

    @classmethod
    def of(
        cls, entry: str | Sequence[str], where: str | Sequence[str] | None = None, **options: Any
    ) -> Measure:
        """Return a measure from values of a YAML file, in which keys are lists."""
        typed: dict[str, Any] = {
            key: None if value is None else TYPES[key](value) for key, value in options.items()
        }
        return cls(_key(entry), where=None if where is None else _key(where), **typed)

    def heading(self, name: str) -> str:
        """Return the heading of the column of a measure of some name; empty where it has none."""
        return name if self.title is None else self.title

    def node(self) -> dict[str, Any]:
        """Return the values for a YAML file."""
        values = asdict(self).items()
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values}

    def pool(self, values: Sequence[float], episodes: Sequence[float] | None = None) -> float:
        """Return the mean of the episodes that have a number, see `denominators`.

        Of numbers it is the minimum of minima, and the maximum of maxima.

        Args:
            values: of the episodes, or means of some; NaN for one without a number.
            episodes: how many episodes each value is the mean of, or which share of as many; None
                for one.
        """
        counts = [1] * len(values) if episodes is None else episodes
        known = [not math.isnan(value) for value in values]
        numbers = [float(value) for value in compress(values, known)]
        mean = partial(fmean, weights=list(compress(counts, known)))
        is_flag = self.at_least is not None or self.at_most is not None
        pools: dict[str, Callable[[Sequence[float]], float]] = (
            {} if is_flag else {"min": min, "max": max}
        )
        return pools.get(self.reduction, mean)(numbers) if numbers else math.nan


def _key(key: Any) -> str | tuple[str, ...]:
    if isinstance(key, str):
        return key
    if not isinstance(key, Sequence) or not key or not all(isinstance(part, str) for part in key):
        raise ValueError(f"{key} is no entry; name one, as in reward or [info, lap]")
    return tuple(key)


def in_info(key: str | tuple[str, ...]) -> bool:
    """Return whether an entry is one of `info`, in which NaN is a number without a value."""
    return not isinstance(key, str) and key[0] == "info"


def measures_of(nodes: Mapping[str, Any]) -> dict[str, Measure]:
    """Return measures by name from the key `evaluation.measures` of a configuration.

    Raises:
        UserError: for a node that is no measure, one with an unknown key or a value that does not
            fit, and for the name of another column of the tables.
    """
    measures, known = {}, [each.name for each in fields(Measure)]
    for name, node in nodes.items():
        if name in TAKEN or name.endswith(EPISODES):
            raise UserError(
                f"evaluation.measures.{name}: {name} is already a column of the tables; give the "
                "measure another name"
            )
        if not isinstance(node, Mapping) or ("entry" not in node and node.keys() <= set(known)):
            raise UserError(
                f"evaluation.measures.{name}={node} is no measure; write "
                f"evaluation.measures.{name}.entry=ENTRY and, where it is not the mean over the "
                "steps, its reduction"
            )
        for unknown in node.keys() - set(known):
            raise UserError(
                f"there is no key {unknown}; evaluation.measures.{name} has {', '.join(known)}"
                f"{did_you_mean(str(unknown), known)}"
            )
        try:
            measures[name] = Measure.of(**node)
        except (TypeError, ValueError) as error:
            raise UserError(f"evaluation.measures.{name}: {error}") from error
    return measures


def summarise(
    episodes: Sequence[Mapping[str, Any]], measures: Mapping[str, Measure]
) -> list[dict[str, Any]]:
    """Return the means of each case, then their mean as the case `MEAN_CASE`.

    The cases are in the order of the episodes. A measure is pooled over the episodes that have it,
    see `denominators`, and counts in the mean of the cases by their share in each. The mean of the
    return is NaN if that of an episode is.

    Args:
        episodes: `case`, `reward` and the measures of each.
        measures: by name.
    """
    cases = _by_case(episodes)

    def pool(
        case: str, rows: Sequence[Mapping[str, Any]], shares: Mapping[str, Sequence[float]]
    ) -> dict[str, Any]:
        means = {"case": case, "reward": fmean(float(row["reward"]) for row in rows)}
        for name, measure in measures.items():
            means[name] = measure.pool([row[name] for row in rows], shares.get(name))
        return means

    rows = [pool(case, group, {}) for case, group in cases.items()]
    shares = {name: [_share(group, name) for group in cases.values()] for name in measures}
    return [*rows, pool(MEAN_CASE, rows, shares)]


def _by_case(episodes: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    cases: dict[str, list[Mapping[str, Any]]] = {}
    for episode in episodes:
        cases.setdefault(episode["case"], []).append(episode)
    return cases


def _share(episodes: Sequence[Mapping[str, Any]], name: str) -> float:
    """Return the share of episodes that have a measure."""
    return fmean(not math.isnan(episode[name]) for episode in episodes)


def denominators(
    episodes: Sequence[Mapping[str, Any]], measures: Mapping[str, Measure]
) -> list[dict[str, int]]:
    """Return how many episodes each number of `summarise` rests on.

    Args:
        episodes: `case`, `reward` and the measures of each.
        measures: by name.

    Returns:
        A row for each of `summarise`: `episodes`, and by name the number of those with a number.
    """
    names, counts = ("reward", *measures), []
    for group in (*_by_case(episodes).values(), episodes):
        known = {name: sum(not math.isnan(row[name]) for row in group) for name in names}
        counts.append({"episodes": len(group)} | known)
    return counts


def with_denominators(
    rows: Sequence[Mapping[str, Any]], counts: Sequence[Mapping[str, int]]
) -> list[dict[str, Any]]:
    """Return rows with a column `NAME_episodes` for each mean that leaves episodes out in any row.

    The number of all episodes is then the column `episodes`.

    Args:
        rows: of `summarise`.
        counts: of `denominators`.
    """
    names = [name for name in counts[0] if name != "episodes"] if counts else []
    partial = [name for name in names if any(count[name] < count["episodes"] for count in counts)]
    if not partial:
        return [dict(row) for row in rows]
    result = []
    for row, count in zip(rows, counts, strict=True):
        of_measures = {f"{name}{EPISODES}": count[name] for name in partial}
        result.append({**row, "episodes": count["episodes"], **of_measures})
    return result
