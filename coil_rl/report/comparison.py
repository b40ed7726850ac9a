"""Comparison of policies over seeds: agents grouped by label, and their guides."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from coil_rl.errors import UserError
from coil_rl.measures import EPISODES, Measure, with_denominators
from coil_rl.record import DRIVER
from coil_rl.report.guides import is_guide, shared_guides
from coil_rl.report.runs import FALLBACK, GUIDE, TERM, Run, by_label
from coil_rl.report.sentences import listed
from coil_rl.report.statistics import Array, Estimate, count_of_seeds, estimate, holm, wins
from coil_rl.report.table import return_format

LABELS_IN_NAME = 2  # of a guide, if there are several guides of one name


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
        labels: of the runs of an agent one; of those of a guide all that share it.
        of_runs: for a guide the number of its evaluation in the table, by label and seed of a run.
    """

    name: str
    advice: str
    table: pd.DataFrame
    is_guide: bool = False
    guide: Group | None = None
    needs_guide: bool | None = None
    measures: Mapping[str, Measure] = field(default_factory=dict, repr=False)
    labels: tuple[str, ...] = ()
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
        index = self.table.index.unique("seed")
        values = self.table[measure].to_numpy().reshape(len(index), -1)
        return pd.DataFrame(values, index, self.cases)

    def beside(self, other: Group) -> tuple[list[int], list[int]]:
        """Return the seeds that this policy has in common with another one.

        Of a guide with several evaluations it is the one of the same run; the only one of a guide
        without random actions is beside every seed.

        Args:
            other: the other policy.

        Returns:
            The seeds here, and for each of them the seed in the table of the other policy.
        """
        seeds = self.table.index.unique("seed").tolist()
        if other.is_guide and other.seeds is None:
            return seeds, other.table.index.unique("seed").tolist() * len(seeds)
        theirs = {seed: seed for seed in other.table.index.unique("seed")}
        if other.is_guide:
            theirs = {
                seed: number
                for (label, seed), number in other.of_runs.items()
                if label in self.labels
            }
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
    def episodes(self) -> pd.DataFrame:
        """How many `episodes` each result is the mean of, and how many of them have each measure.

        The columns are those of `with_denominators`. A run leaves them out if all of its episodes
        have all measures; it has as many episodes as the others, or, if none has the columns, one.
        """
        table = self.table
        ran = table.get("episodes", pd.Series(1, table.index))
        counts = {"episodes": ran.fillna(ran.max()).fillna(1)}
        for name in self.measures:
            if name in table:
                known = table.get(f"{name}{EPISODES}", ran).fillna(counts["episodes"])
                counts[name] = known.clip(lower=1).where(table[name].notna(), 0)
        return pd.DataFrame(counts)

    def counts(self, case: str | None = None) -> dict[str, int]:
        """Return the number of `episodes`, and by measure in how many of them it is known.

        Args:
            case: the only case to count; None for all of them.
        """
        known = _of_case(self.episodes, case).sum().astype(int)
        return dict.fromkeys(("episodes", *self.measures), 0) | known.to_dict()

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
        crashed, unit = (self.by_seed("crashed") > 0).to_numpy(), ""
        if self.seeds is None:
            crashed, unit = crashed.T, " cases"
        return count_of_seeds(int(crashed.any(axis=1).sum()), len(crashed), unit)

    def has(self, measure: str) -> bool:
        """Return whether a measure is known in all cases."""
        return measure in self.table and not self.table[measure].isna().to_numpy().any()

    def means(self, case: str | None = None) -> dict[str, float]:
        """Return reward and measures over seeds and cases: means, of minima the smallest.

        A measure counts as often as there are episodes that have it.

        Args:
            case: the only case to count; None for all of them.
        """
        rows, counts = _of_case(self.table, case), _of_case(self.episodes, case)
        means = {"reward": float(rows["reward"].to_numpy().mean())}
        for name in self.episodes.columns[1:]:
            means[name] = self.measures[name].pool(rows[name].tolist(), counts[name].tolist())
        return means

    def terms(self) -> dict[str, float]:
        """Return the terms of the reward by the names of their measures, which have no heading."""
        return {
            name: mean
            for name, mean in self.means().items()
            if name.startswith(TERM) and not self.measures[name].heading(name)
        }


def _of_case(rows: pd.DataFrame, case: str | None) -> pd.DataFrame:
    """Return the rows of a case of a table that is indexed by seed and case; all for None."""
    return rows if case is None else rows.xs(case, level="case")


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
            means, other = group.means(), self._other(group, against)
            pairs = None if other is None else paired(group, other)
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
        return with_denominators(rows, [group.counts() for group in self.groups])

    def case_table(self) -> list[dict[str, Any]]:
        """Return one row per policy and case."""
        rows, counts = [], []
        for group in self.groups:
            about = {"driver": group.name, "advice": group.advice, "seeds": group.seeds}
            for case in group.cases:
                rows.append(about | {"case": case} | group.means(case))
                counts.append(group.counts(case))
        return with_denominators(rows, counts)

    def unpaired(self, against: str | None) -> list[str]:
        """Return the agents without a seed in common with what they are compared with.

        Args:
            against: see `table`.
        """
        names = []
        for group in self.agents:
            other = self._other(group, against)
            if other is not None and not group.advice and not group.beside(other)[0]:
                names.append(group.name)
        return names

    def _other(self, group: Group, against: str | None) -> Group | None:
        """Return the policy that a group is compared with; None if there is none."""
        agents = {agent.name: agent for agent in self.agents if not agent.advice}
        other = group.guide if against == GUIDE else agents.get(against or "")
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
    labels = by_label(finished)
    joined = {label: _join_runs(own) for label, own in labels.items()}
    measures: dict[str, Measure] = {}
    for run in reversed(finished):  # the first run of a name defines it
        measures |= run.measures
    guides = _guides(chain.from_iterable(labels.values()), measures)
    agents: list[Group] = []
    for label, frame in joined.items():
        rows = frame[~is_guide(frame) & (frame["actions"] == actions)]
        for (driver, advice), own in rows.groupby(["driver", "advice"], sort=False):
            needs = None if advice else labels[label][0].needs_guide or driver.endswith(FALLBACK)
            agents.append(
                Group(
                    driver,
                    advice,
                    _index(driver, own),
                    guide=next((each for each in guides if label in each.labels), None),
                    needs_guide=needs,
                    measures=measures,
                    labels=(label,),
                )
            )
    agents.sort(key=lambda group: (group.advice != "", group.rank))
    # The first group of a name is the one with unaltered advice.
    best = {group.name: group.rank for group in reversed(agents)}
    agents.sort(key=lambda group: (best[group.name], group.name))
    return Comparison(tuple(guides), tuple(agents))


def _join_runs(runs: Sequence[Run]) -> pd.DataFrame:
    """Join the evaluations of the runs of one label."""
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


def _guides(runs: Iterable[Run], measures: Mapping[str, Measure]) -> list[Group]:
    """Return the different guides of all labels, best first.

    Args:
        runs: as `shared_guides` takes them.
        measures: definitions by name.
    """
    guides, different = shared_guides(runs)
    names = [name for name, _ in guides]
    groups = []
    for name, of_runs in guides:
        own = tuple(dict.fromkeys(label for label, _ in of_runs))
        places = {number: place for place, number in enumerate(dict.fromkeys(of_runs.values()))}
        rows = pd.concat([different[number].assign(seed=place) for number, place in places.items()])
        groups.append(
            Group(
                name if names.count(name) == 1 else f"{name} ({listed(own, LABELS_IN_NAME)})",
                "",
                _index(f"the guide of {own[0]}", rows),
                is_guide=True,
                measures=measures,
                labels=own,
                of_runs={run: places[number] for run, number in of_runs.items()},
            )
        )
    return sorted(groups, key=lambda group: group.rank)


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
    seeds, of_other = group.beside(other)
    ours, theirs = group.by_seed(measure).loc[seeds], other.by_seed(measure).loc[of_other]
    x, y = ours.to_numpy(), theirs.to_numpy()
    counts = np.isfinite(x) & np.isfinite(y)
    if not x.size or not counts.any(axis=1).all():
        return None
    if measure == "reward" and not counts.all():
        return None
    differences = np.where(counts, x - y, 0).sum(axis=1) / counts.sum(axis=1)
    return Paired(estimate(differences), float(wins(x, y)[counts].mean()))
