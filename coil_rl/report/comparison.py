"""Comparison of policies over seeds: agents grouped by label, and their guides.

pandas is imported where it is used, because a training does without it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from coil_rl.errors import UserError
from coil_rl.measures import Measure
from coil_rl.record import DRIVER
from coil_rl.report.guides import is_guide, shared_guides
from coil_rl.report.runs import FALLBACK, GUIDE, Run
from coil_rl.report.statistics import Array, Estimate, count_of_seeds, estimate, holm, wins
from coil_rl.report.table import return_format

if TYPE_CHECKING:
    import pandas as pd

EPISODES = "_episodes"  # suffix of the columns of `with_denominators`


@dataclass(frozen=True, eq=False)
class Group:
    """Evaluations of one policy over seeds.

    Attributes:
        name: the label of an agent, "LABEL or guide" for it with a fallback, "guide" or "guide
            NAME" for a guide; the labels are appended if several guides share it.
        advice: modification of the advice; empty for none.
        table: indexed by (seed, case); for a guide the seeds number its different evaluations.
        is_guide: whether the policy is a guide alone.
        guide: the best guide of an agent; None for none.
        needs_guide: whether the policy needs its guide during evaluation; None if that does not
            apply.
        measures: definitions of the measures in the table by name.
        label: of the runs of an agent; empty for a guide.
        of_runs: for a guide the number of its evaluation in the table, by label and seed of a run.
    """

    name: str
    advice: str
    table: pd.DataFrame
    is_guide: bool = False
    guide: Group | None = None
    needs_guide: bool | None = None
    measures: Mapping[str, Measure] = field(default_factory=dict, repr=False)
    label: str = ""
    of_runs: Mapping[tuple[str, int], int] = field(default_factory=dict, repr=False)

    @property
    def title(self) -> str:
        """Name and modification of the advice."""
        return f"{self.name}, {self.advice}" if self.advice else self.name

    @cached_property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases."""
        return tuple(self.table.index.unique("case"))

    @property
    def seeds(self) -> int | None:
        """Number of seeds; None for a guide without random actions."""
        count = len(self.table.index.unique("seed"))
        return None if self.is_guide and count == 1 else count

    @property
    def returns(self) -> Array:
        """Rewards, [seeds, cases]."""
        return self.by_seed("reward").to_numpy()

    def by_seed(self, measure: str) -> pd.DataFrame:
        """Return a measure with seeds as rows and cases as columns.

        Args:
            measure: name of the measure, or "reward".
        """
        import pandas as pd

        index = self.table.index.unique("seed")
        values = self.table[measure].to_numpy().reshape(len(index), -1)
        return pd.DataFrame(values, index, self.cases)

    def beside(self, other: Group) -> tuple[list[int], list[int]]:
        """Return the seeds that this policy has in common with another one.

        Of a guide with several evaluations it is the one of the same run.

        Args:
            other: the other policy.

        Returns:
            The seeds here, and for each of them the seed in the table of the other policy.
        """
        seeds = self.table.index.unique("seed").tolist()
        theirs = {seed: seed for seed in other.table.index.unique("seed")}
        if other.is_guide:
            numbers = {seed: other.of_runs.get((self.label, seed)) for seed in seeds}
            theirs = {seed: number for seed, number in numbers.items() if number is not None}
        common = [seed for seed in seeds if seed in theirs]
        return common, [theirs[seed] for seed in common]

    @cached_property
    def reward(self) -> Estimate:
        """Mean reward, with its interval over the seeds."""
        return estimate(self.returns.mean(axis=1))

    @cached_property
    def reward_of_cases(self) -> Estimate:
        """Mean reward, with the interval over the cases: of the means over seeds in each case."""
        return estimate(self.returns.mean(axis=0))

    @cached_property
    def of_measures(self) -> dict[str, tuple[Array, Array, Array]]:
        """The reward and each measure: values, episodes that have one, episodes, [seeds, cases]."""
        count, found = len(self.table.index.unique("seed")), {}
        for name in ("reward", *self.measures):
            if name in self.table:
                columns = (self.table[name], *_episodes(self.table, name))
                values, known, episodes = (each.to_numpy().reshape(count, -1) for each in columns)
                found[name] = values, known, episodes
        return found

    def counts(self, case: int | None = None) -> dict[str, int]:
        """Return the number of `episodes`, and by measure in how many of them it is known.

        Args:
            case: index of the only case to count; None for all of them.
        """
        at = slice(None) if case is None else slice(case, case + 1)
        counts = {"episodes": int(self.of_measures["reward"][2][:, at].sum())}
        for name in self.measures:
            if name in self.of_measures:
                counts[name] = int(self.of_measures[name][1][:, at].sum())
        return counts

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Sort key: the completed share, then the mean reward, the best first.

        A policy without such a mean, because a return is no number, is the last one.
        """
        completed = self.table["completed"].mean() if "completed" in self.table else 0.0
        mean = self.reward.mean
        return math.isnan(mean), -float(np.nan_to_num(completed)), -float(np.nan_to_num(mean))

    @property
    def crashes(self) -> str | None:
        """Number of seeds that crashed in any case, with the interval of its share.

        For a guide with a single evaluation it is the number of cases, with the interval of its
        share. It is None if crashes are not measured.
        """
        if not self.has("crashed"):
            return None
        crashed = self.by_seed("crashed")
        if self.seeds is None:
            count = int((crashed > 0).to_numpy().sum())
            share, _, interval = count_of_seeds(count, len(self.cases)).partition(" (")
            return f"{share} cases ({interval}"
        return count_of_seeds(int((crashed > 0).any(axis=1).sum()), self.seeds)

    def has(self, measure: str) -> bool:
        """Return whether a measure is known in all cases."""
        return measure in self.table and not self.table[measure].isna().to_numpy().any()

    def means(self, case: int | None = None) -> dict[str, float]:
        """Return reward and measures over seeds and cases: means, of minima the smallest.

        A measure counts as often as there are episodes that have it.

        Args:
            case: index of the only case to count; None for all of them.
        """
        at = slice(None) if case is None else slice(case, case + 1)
        means = {"reward": float(self.of_measures["reward"][0][:, at].mean())}
        for name, each in self.measures.items():
            if name in self.of_measures:
                values, known, _ = (part[:, at].ravel() for part in self.of_measures[name])
                means[name] = each.pool(values.tolist(), known.tolist())
        return means

    def parts(self, prefix: str) -> dict[str, float]:
        """Return the mean of each column with a prefix, over the seeds and cases that have it.

        Args:
            prefix: PER_STEP or TERM.
        """
        columns = [
            column
            for column in self.table
            if column.startswith(prefix) and not column.endswith(EPISODES)
        ]
        return {column: float(self.table[column].mean()) for column in columns}


def _episodes(rows: pd.DataFrame, measure: str) -> tuple[pd.Series, pd.Series]:
    """Return how many episodes of each result have a measure, and how many episodes there are.

    The columns are those of `with_denominators`. A run leaves them out if all of its episodes have
    all measures; it has as many episodes as the others, or, if none has the columns, one.
    """
    known = rows[measure].notna()
    if "episodes" not in rows:
        return known.astype(int), known * 0 + 1
    episodes = rows["episodes"].fillna(rows["episodes"].max()).fillna(1)
    counts = rows.get(f"{measure}{EPISODES}", episodes).fillna(episodes)
    return counts.clip(lower=1).where(known, 0), episodes


@dataclass(frozen=True)
class Comparison:
    """The compared policies.

    Attributes:
        guides: the guides, best first.
        agents: the agents, best first, each followed by its variants with altered advice.
    """

    guides: tuple[Group, ...]
    agents: tuple[Group, ...]

    @property
    def groups(self) -> tuple[Group, ...]:
        """Guides and agents."""
        return (*self.guides, *self.agents)

    @property
    def spec(self) -> str:
        """Number format of the rewards."""
        return return_format(group.reward.mean for group in self.groups)

    def table(self, against: str | None = None) -> list[dict[str, Any]]:
        """Return one row per policy, guides first.

        `difference` is the reward of an agent minus that of another policy with the same seed, the
        mean over the `difference_seeds` that both have; `p` is corrected for all rows.

        Args:
            against: label of the agent to compare with; "guide" for the guide of each agent; None
                for no comparison.
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
                    "cases": len(group.cases),
                    "completed": means.pop("completed", None),
                    "crashes": group.crashes,
                    "reward": means.pop("reward"),
                    "low": group.reward.low,
                    "high": group.reward.high,
                    "low_of_cases": group.reward_of_cases.low,
                    "high_of_cases": group.reward_of_cases.high,
                    **means,
                    **self._partial(group),
                    "difference": difference.mean,
                    "difference_low": difference.low,
                    "difference_high": difference.high,
                    "difference_seeds": difference.seeds if pairs else None,
                    "p": difference.p,
                    "better": pairs.better if pairs else None,
                    "needs_guide": group.needs_guide,
                }
            )
        for row, p in zip(rows, holm([row["p"] for row in rows]), strict=True):
            row["p"] = float(p)
        return rows

    @cached_property
    def _unknown(self) -> list[str]:
        """The measures that are not known in all episodes."""
        found = [each.counts() for each in self.groups]
        return [name for each in found for name in each if 0 < each[name] < each["episodes"]]

    def _partial(self, group: Group, case: int | None = None) -> dict[str, int]:
        """Return in how many episodes each measure is known, unless it is in all episodes.

        With such a measure the number of all episodes is among them.

        Args:
            case: index of the only case to count; None for all of them.
        """
        if not self._unknown:
            return {}
        counts = group.counts(case)
        known = {f"{name}{EPISODES}": counts.get(name, 0) for name in self._unknown}
        return {"episodes": counts["episodes"]} | known

    def case_table(self) -> list[dict[str, Any]]:
        """Return one row per policy and case."""
        rows = []
        for group in self.groups:
            about = {"driver": group.name, "advice": group.advice, "seeds": group.seeds}
            for index, case in enumerate(group.cases):
                means, counts = group.means(index), self._partial(group, index)
                rows.append(about | {"case": case} | means | counts)
        return rows

    def unpaired(self, against: str | None) -> list[str]:
        """Return the agents without a seed in common with what they are compared with.

        Args:
            against: see `table`.
        """
        names = []
        for group in self.agents:
            other = self._other(group, against)
            if other is None or group.advice or _is_shared(other):
                continue
            if not group.beside(other)[0]:
                names.append(group.name)
        return names

    def _pairs(self, group: Group, against: str | None) -> Paired | None:
        """Return the comparison of a policy with `against`; None if they cannot be compared."""
        other = self._other(group, against)
        return None if other is None else paired(group, other)

    def _other(self, group: Group, against: str | None) -> Group | None:
        """Return the policy that a group is compared with; None if there is none."""
        if against == GUIDE:
            other = group.guide
        else:
            agents = {agent.name: agent for agent in self.agents if not agent.advice}
            other = agents.get(against or "")
        return None if other is group or group.is_guide else other


def compare(runs: Sequence[Run], actions: str = "deterministic") -> Comparison:
    """Group the finished runs by label.

    Args:
        runs: of which at least one is finished.
        actions: of the agents, "deterministic" or "sampled".

    Raises:
        UserError: if two runs have the same label and seed, or the same label and other cases.
    """
    finished = [run for run in runs if run.finished]
    labels = {
        label: _join_runs([run for run in finished if run.label == label])
        for label in dict.fromkeys(run.label for run in finished)
    }
    measures = _definitions(finished)
    guides = _group_guides(labels, measures)
    unique = dict.fromkeys(chain.from_iterable(guides.values()))
    needs_guide = {run.label: run.needs_guide for run in reversed(finished)}
    agents: list[Group] = []
    for label, frame in labels.items():
        rows = frame[~is_guide(frame) & (frame["actions"] == actions)]
        best_guide = guides[label][0] if label in guides else None
        variants = _variants(label, rows, measures, best_guide, needs_guide[label])
        agents += sorted(variants, key=lambda group: (group.advice != "", group.rank))
    # The first group of a name is the one with unaltered advice.
    best = {group.name: group.rank for group in reversed(agents)}
    agents.sort(key=lambda group: (best[group.name], group.name))
    ranked = tuple(sorted(unique, key=lambda group: group.rank))
    return Comparison(ranked, tuple(agents))


def _definitions(runs: Sequence[Run]) -> dict[str, Measure]:
    """Return the measures of all runs by name, as the first run defines each of them."""
    measures: dict[str, Measure] = {}
    for run in reversed(runs):
        measures |= run.measures
    return measures


def _variants(
    label: str,
    rows: pd.DataFrame,
    measures: Mapping[str, Measure],
    guide: Group | None,
    needs_guide: bool | None,
) -> list[Group]:
    """Return the agent of a label, with each alteration of its advice, and with a fallback.

    Args:
        measures: definitions by name.
        needs_guide: whether it needs the guide during evaluation.
    """
    variants = []
    for (driver, advice), own in rows.groupby(["driver", "advice"], sort=False):
        variant = Group(
            driver,
            advice,
            _index(driver, own),
            guide=guide,
            needs_guide=None if advice else needs_guide or driver.endswith(FALLBACK),
            measures=measures,
            label=label,
        )
        variants.append(variant)
    return variants


def _join_runs(runs: Sequence[Run]) -> pd.DataFrame:
    """Join the evaluations of the runs of one label."""
    import pandas as pd

    first: dict[int, Run] = {}
    for run in runs:
        if run.seed in first:
            raise UserError(
                f"{first[run.seed].folder} and {run.folder} are both seed {run.seed} of "
                f"{run.label}; remove one from the folder, or give different runs their own labels "
                "(coil-train label=TEXT)"
            )
        first[run.seed] = run
    return pd.concat([run.evaluation.assign(seed=run.seed) for run in runs])


def _index(name: str, rows: pd.DataFrame) -> pd.DataFrame:
    """Index the evaluations of one policy by seed and case."""
    cases = rows.groupby("seed")["case"].agg(tuple).unique()
    if len(cases) > 1:
        raise UserError(
            f"runs of {name} were evaluated in different cases "
            f"({', '.join(cases[0])}, and {', '.join(cases[1])}); evaluate them on the same ones, "
            "or give them their own labels (coil-train label=TEXT)"
        )
    return rows.set_index(["seed", "case"]).drop(columns=list(DRIVER), errors="ignore")


def _group_guides(
    labels: Mapping[str, pd.DataFrame], measures: Mapping[str, Measure]
) -> dict[str, list[Group]]:
    """Return the guides of each label, best first.

    Args:
        labels: the evaluations by label.
        measures: definitions by name.
    """
    guides = shared_guides(labels)
    names = [guide.name for guide in guides]
    groups: dict[str, list[Group]] = {}
    for guide in guides:
        is_unique = names.count(guide.name) == 1
        name = guide.name if is_unique else f"{guide.name} ({guide.listed()})"
        table = _index(f"the guide of {guide.labels[0]}", guide.rows())
        group = Group(name, "", table, is_guide=True, measures=measures, of_runs=guide.numbers())
        for label in guide.labels:
            groups.setdefault(label, []).append(group)
    return {
        label: sorted(of_label, key=lambda group: group.rank) for label, of_label in groups.items()
    }


@dataclass(frozen=True)
class Paired:
    """Difference between two policies with the same seeds.

    Attributes:
        difference: of a measure, mean over cases, for the seeds that both have.
        better: share of seeds and cases with a higher value, ties counting half.
    """

    difference: Estimate
    better: float


def paired(group: Group, other: Group, measure: str = "reward") -> Paired | None:
    """Compare two policies seed by seed.

    A case counts for a seed if both have a number there, as lap times where both completed one. Of
    rewards every one has to be a number: a policy that diverged in a case is not judged by the
    others.

    Args:
        group: the first policy.
        other: the second policy; a guide with a single evaluation has one value for all seeds, and
            one with several that of the same run.
        measure: name of the measure to compare, or "reward".

    Returns:
        None without common cases and seeds, if a seed has no such case, or a reward is no number.
    """
    if group.cases != other.cases:
        return None
    ours, theirs = group.by_seed(measure), other.by_seed(measure)
    if not _is_shared(other):
        seeds, of_other = group.beside(other)
        ours, theirs = ours.loc[seeds], theirs.loc[of_other]
    x, y = ours.to_numpy(), theirs.to_numpy()
    counts = np.isfinite(x) & np.isfinite(y)
    if not x.size or not counts.any(axis=1).all():
        return None
    if measure == "reward" and not counts.all():
        return None
    differences = np.where(counts, x - y, 0).sum(axis=1) / counts.sum(axis=1)
    return Paired(estimate(differences), float(wins(x, y)[counts].mean()))


def _is_shared(other: Group) -> bool:
    """Return whether all seeds are compared with one value: of a guide without random actions."""
    return other.is_guide and other.seeds is None
