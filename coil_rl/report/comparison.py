"""Comparison of drivers over seeds: agents grouped by label, and their guides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from coil_rl.errors import UserError
from coil_rl.report.measures import Measure
from coil_rl.report.runs import DRIVER, GUIDE, Run
from coil_rl.report.statistics import Array, Estimate, count_of_seeds, estimate, holm, wins

LABELS_IN_NAME = 2  # of a guide, if there are several guides of one name


@dataclass(frozen=True, eq=False)
class Group:
    """Evaluations of one driver over seeds."""

    # The label of an agent, "guide" or "guide NAME" for a guide; the labels are appended if several
    # guides share it.
    name: str
    advice: str  # modification of the advice; empty for none
    table: (
        pd.DataFrame
    )  # indexed by (seed, case); for a guide the seeds number its different evaluations
    is_guide: bool = False
    guide: Group | None = None  # the best one of an agent
    needs_guide: bool | None = None  # during evaluation; None if that does not apply
    measures: Mapping[str, Measure] = field(
        default_factory=dict, repr=False
    )  # definitions of those in the table
    reference: Array | None = (
        None  # rewards that scores are divided by, [cases]; None: scores are rewards
    )

    @property
    def title(self) -> str:
        """Name and modification of the advice."""
        return f"{self.name}, {self.advice}" if self.advice else self.name

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases."""
        return tuple(self.table.index.unique("case"))

    @property
    def seeds(self) -> int | None:
        """Number of seeds; None for a guide without random actions."""
        count = len(self.table.index.unique("seed"))
        return None if self.is_guide and count == 1 else count

    @property
    def scores(self) -> Array:
        """Rewards divided by those of the reference in the same case, [seeds, cases]."""
        return self.by_seed("score").to_numpy()

    def by_seed(self, measure: str) -> pd.DataFrame:
        """Return the reward, a measure, or "score", with seeds as rows and cases as columns."""
        index, score = self.table.index.unique("seed"), measure == "score"
        values = self.table["reward" if score else measure].to_numpy().reshape(len(index), -1)
        if score and self.reference is not None:
            values = values / self.reference
        return pd.DataFrame(values, index, self.cases)

    @cached_property
    def score(self) -> Estimate:
        """Mean score."""
        return estimate(self.scores.mean(axis=1))

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key: the completed share, then the mean score, the best first."""
        completed = self.table["completed"].mean() if "completed" in self.table else 0.0
        return -float(np.nan_to_num(completed)), -self.score.mean

    @property
    def crashes(self) -> str | None:
        """Number of seeds that crashed in any case, with the interval of its share; cases for a single guide."""
        if not self.has("crashed"):
            return None
        crashed = self.by_seed("crashed")
        if self.seeds is None:
            return f"{int((crashed > 0).to_numpy().sum())} of {len(self.cases)} cases"
        return count_of_seeds(int((crashed > 0).any(axis=1).sum()), self.seeds)

    def has(self, measure: str) -> bool:
        """Return whether a measure is known in all cases."""
        return measure in self.table and not self.table[measure].isna().to_numpy().any()

    def means(self, case: int | None = None) -> dict[str, float]:
        """Return reward and measures over seeds and cases, or one case: means, of minima the smallest."""
        rows = self.table if case is None else self.table.xs(self.cases[case], level="case")
        means = {"reward": float(rows["reward"].mean())}
        return means | {
            name: each.pool(rows[name].tolist())
            for name, each in self.measures.items()
            if name in rows
        }

    def parts(self, prefix: str) -> dict[str, float]:
        """Return the mean of each column with a prefix, PER_STEP or TERM, over the seeds and cases that have it."""
        columns = [column for column in self.table if column.startswith(prefix)]
        return {column: float(self.table[column].mean()) for column in columns}


@dataclass(frozen=True)
class Comparison:
    """Guides, best first, and agents, best first, each followed by its variants with altered advice."""

    guides: tuple[Group, ...]
    agents: tuple[Group, ...]

    @property
    def groups(self) -> tuple[Group, ...]:
        """Guides and agents."""
        return (*self.guides, *self.agents)

    @property
    def normalised(self) -> bool:
        """Whether scores are fractions of a guide's reward; otherwise they are rewards."""
        return any(group.reference is not None for group in self.groups)

    @property
    def score(self) -> tuple[str, str]:
        """Name and number format of the scores."""
        return ("reward / guide's", ".3f") if self.normalised else ("reward", ".1f")

    def table(self, against: str | None = None) -> list[dict[str, Any]]:
        """Return one row per driver, guides first.

        `difference` is the score of an agent minus that of the agent with the label `against`, or
        of its guide if `against` is "guide", with the same seed; `p` is corrected for all rows.
        """
        rows: list[dict[str, Any]] = []
        for group in self.groups:
            means, pairs = group.means(), self._pairs(group, against)
            difference = pairs.difference if pairs else Estimate(np.nan)
            rows.append(
                {
                    "driver": group.name,
                    "advice": group.advice,
                    "guide": group.guide.name if group.guide else None,
                    "seeds": group.seeds,
                    "completed": means.pop("completed", None),
                    "crashes": group.crashes,
                    "score": group.score.mean,
                    "low": group.score.low,
                    "high": group.score.high,
                    **means,
                    "difference": difference.mean,
                    "difference_low": difference.low,
                    "difference_high": difference.high,
                    "p": difference.p,
                    "better": pairs.better if pairs else None,
                    "needs_guide": group.needs_guide,
                }
            )
        for row, p in zip(rows, holm([row["p"] for row in rows]), strict=True):
            row["p"] = float(p)
        return rows

    def case_table(self) -> list[dict[str, Any]]:
        """Return one row per driver and case."""
        return [
            {"driver": group.name, "advice": group.advice, "seeds": group.seeds, "case": case}
            | group.means(index)
            for group in self.groups
            for index, case in enumerate(group.cases)
        ]

    def _pairs(self, group: Group, against: str | None) -> Paired | None:
        agents = {agent.name: agent for agent in self.agents if not agent.advice}
        other = group.guide if against == GUIDE else agents.get(against or "")
        return None if other is None or other is group or group.is_guide else paired(group, other)


def compare(runs: Sequence[Run], actions: str = "deterministic") -> Comparison:
    """Group the finished runs, at least one, by label; `actions` of the agents are "deterministic" or "sampled".

    Two runs with the same label and seed, or with the same label and other cases, are a
    `UserError`.
    """
    finished = [run for run in runs if run.finished]
    names = dict.fromkeys(run.label for run in finished)
    labels = {label: _join_runs([run for run in finished if run.label == label]) for label in names}
    is_guide = {
        label: frame["driver"].str.split().str[0] == GUIDE for label, frame in labels.items()
    }
    measures = {
        name: measure for run in reversed(finished) for name, measure in run.measures.items()
    }
    guides = _group_guides(
        {label: frame[is_guide[label]] for label, frame in labels.items()}, measures
    )
    references = _references(
        [group for of_label in guides.values() for group in of_label], finished
    )
    unique = dict.fromkeys(group for of_label in guides.values() for group in of_label)
    normalised = {group: replace(group, reference=references.get(group.cases)) for group in unique}
    guides = {
        label: [normalised[group] for group in of_label] for label, of_label in guides.items()
    }
    needs_guide = {run.label: run.needs_guide for run in reversed(finished)}
    agents: list[Group] = []
    for label, frame in labels.items():
        rows = frame[~is_guide[label] & (frame["actions"] == actions)]
        guide = next(iter(guides.get(label, ())), None)
        variants = [
            Group(
                label,
                advice,
                _index(label, variant),
                False,
                guide,
                None if advice else needs_guide[label],
                measures,
            )
            for advice, variant in rows.groupby("advice", sort=False)
        ]
        variants = [
            replace(variant, reference=references.get(variant.cases)) for variant in variants
        ]
        agents += sorted(variants, key=lambda group: (group.advice != "", group.rank))
    best = {
        group.name: group.rank for group in reversed(agents)
    }  # the first group of a label: unaltered advice
    agents.sort(key=lambda group: (best[group.name], group.name))
    return Comparison(
        tuple(sorted(normalised.values(), key=lambda group: group.rank)), tuple(agents)
    )


def _references(guides: Sequence[Group], runs: Sequence[Run]) -> dict[tuple[str, ...], Array]:
    """Return by cases the rewards of the best guide; where it crashes or earns nothing, its mean over the others.

    The result is empty if a run drove cases in which no guide earns anything: scores of all runs
    are to be alike.
    """
    references: dict[tuple[str, ...], Array] = {}
    for guide in sorted(guides, key=lambda group: group.rank):
        rewards = guide.by_seed("reward").mean()
        earned = rewards[rewards > 0]
        if guide.has("crashed"):
            earned = earned[~(guide.by_seed("crashed") > 0).any()]
        if len(earned):
            references.setdefault(
                guide.cases, rewards.where(rewards.index.isin(earned.index), earned.mean()).values
            )
    return (
        references
        if all(tuple(run.evaluation["case"].unique()) in references for run in runs)
        else {}
    )


def _join_runs(runs: Sequence[Run]) -> pd.DataFrame:
    """Join the evaluations of the runs of one label."""
    first: dict[int, Run] = {}
    for run in runs:
        if run.seed in first:
            problem = (
                f"{first[run.seed].folder} and {run.folder} are both seed {run.seed} of {run.label}"
            )
            remedy = "remove one from the folder, or give different runs their own labels (coil-train label=TEXT)"
            raise UserError(f"{problem}; {remedy}")
        first[run.seed] = run
    return pd.concat([run.evaluation.assign(seed=run.seed) for run in runs])


def _index(name: str, rows: pd.DataFrame) -> pd.DataFrame:
    """Index the evaluations of one driver by seed and case."""
    cases = rows.groupby("seed")["case"].agg(tuple).unique()
    if len(cases) > 1:
        different = f"{', '.join(cases[0])}, and {', '.join(cases[1])}"
        remedy = (
            "evaluate them on the same ones, or give them their own labels (coil-train label=TEXT)"
        )
        raise UserError(f"runs of {name} were evaluated in different cases ({different}); {remedy}")
    return rows.set_index(["seed", "case"]).drop(columns=list(DRIVER), errors="ignore")


def _group_guides(
    labels: dict[str, pd.DataFrame], measures: Mapping[str, Measure]
) -> dict[str, list[Group]]:
    """Return the guides of each label, best first.

    Every run evaluates its guides: equal results of one guide count once, and labels share a guide
    if the results of one contain those of the other. A guide with random actions has one result per
    seed.
    """
    guides: list[
        tuple[str, list[str], dict[Any, pd.DataFrame]]
    ] = []  # name, labels and different results
    for label, frame in labels.items():
        for name, rows in frame.groupby("driver", sort=False):
            seeds = [seed_rows for _, seed_rows in rows.groupby("seed", sort=False)]
            results = {
                (*seed_rows["case"], *seed_rows["reward"].round(3)): seed_rows
                for seed_rows in seeds
            }
            for other, other_labels, other_results in guides:
                fewer, more = sorted((results.keys(), other_results.keys()), key=len)
                if other == name and fewer <= more:
                    other_labels.append(label)
                    other_results.update(results)
                    break
            else:
                guides.append((name, [label], results))
    names = [name for name, _, _ in guides]
    groups: dict[str, list[Group]] = {}
    for name, shared_by, results in guides:
        listed = ", ".join(shared_by)
        if len(shared_by) > LABELS_IN_NAME + 1:
            listed = f"{', '.join(shared_by[:LABELS_IN_NAME])} and {len(shared_by) - LABELS_IN_NAME} more"
        table = pd.concat(
            [rows.assign(seed=number) for number, rows in enumerate(results.values())]
        )
        table = _index(f"the guide of {shared_by[0]}", table)
        unique = name if names.count(name) == 1 else f"{name} ({listed})"
        group = Group(unique, "", table, is_guide=True, measures=measures)
        for label in shared_by:
            groups.setdefault(label, []).append(group)
    return {
        label: sorted(of_label, key=lambda group: group.rank) for label, of_label in groups.items()
    }


@dataclass(frozen=True)
class Paired:
    """Difference between two drivers with the same seeds."""

    difference: Estimate  # of a measure, mean over cases
    better: float  # share of seeds and cases with a higher value, ties counting half


def paired(group: Group, other: Group, measure: str = "score") -> Paired | None:
    """Compare two drivers seed by seed by the score or by a measure; a single guide has one value for all seeds.

    A case counts for a seed if both have a number there, as lap times where both completed one. The
    result is None without common cases and seeds, or if a seed has no such case.
    """
    if group.cases != other.cases or (other.is_guide and other.seeds is not None):
        return None
    ours, theirs = group.by_seed(measure), other.by_seed(measure)
    if not other.is_guide:
        common = [number for number in ours.index if number in theirs.index]
        ours, theirs = ours.loc[common], theirs.loc[common]
    x, y = ours.to_numpy(), theirs.to_numpy()
    counts = np.isfinite(x) & np.isfinite(y)
    if not x.size or not counts.any(axis=1).all():
        return None
    differences = np.where(counts, x - y, 0).sum(axis=1) / counts.sum(axis=1)
    return Paired(estimate(differences), float(wins(x, y)[counts].mean()))
