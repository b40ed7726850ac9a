"""Compares drivers over their seeds: agents by the label of their runs, and the guides beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.errors import UserError
from coil_rl.report.runs import GUIDE, MEASURES, PER_STEP, Drive, Run
from coil_rl.report.statistics import iqm, probability_of_improvement, stratified_bootstrap

Array = NDArray[np.float64]

NAMED = 2  # labels in the name of a guide that several of them have


@dataclass(frozen=True)
class Group:
    """All drives of one driver.

    Attributes:
        name: the label, or what the guide is called and, where several are called so, whose.
        advice: what was done to the advice; empty if nothing was.
        tracks: their names.
        values: [seeds, tracks, MEASURES and tasks].
        tasks: their names; none where the env has none.
        is_guide: whether this is a guide.
        guide: the drives of the best guide beside which an agent drove, if one did.
        needs_guide: whether it needs the guide when it drives; None where that is no question.
        seed_numbers: of the seeds, in their order; none for a guide.
    """

    name: str
    advice: str
    tracks: tuple[str, ...]
    values: Array
    tasks: tuple[str, ...] = ()
    is_guide: bool = False
    guide: Group | None = None
    needs_guide: bool | None = None
    seed_numbers: tuple[int, ...] = ()

    @property
    def title(self) -> str:
        """Name and, if it was altered, what was done to the advice."""
        return f"{self.name}, {self.advice}" if self.advice else self.name

    @property
    def seeds(self) -> int | None:
        """How many; None for a guide that drives alike with each."""
        return None if self.is_guide and len(self.values) == 1 else len(self.values)

    @property
    def scores(self) -> Array:
        """The rewards, [seeds, tracks]."""
        return self.values[..., MEASURES.index("reward")]

    @cached_property
    def iqm(self) -> float:
        """The interquartile mean of all rewards."""
        return float(iqm(self.scores))

    def means(self, track: int | None = None) -> dict[str, float]:
        """The mean of each measure, over all tracks or on one; of `clearance` the smallest, of `lap_time` where any."""
        values = self.values if track is None else self.values[:, [track]]
        columns = {measure: values[..., place] for place, measure in enumerate(MEASURES)}
        laps = columns["lap_time"][np.isfinite(columns["lap_time"])]
        means = {measure: float(column.mean()) for measure, column in columns.items()}
        return means | {
            "lap_time": float(laps.mean()) if laps.size else float("nan"),
            "clearance": float(columns["clearance"].min()),
        }

    @property
    def per_step(self) -> dict[str, float]:
        """The mean reward of a step in each task, over the seeds and tracks on which the task came up."""
        columns = {task: self.values[..., len(MEASURES) + place] for place, task in enumerate(self.tasks)}
        known = {task: column[np.isfinite(column)] for task, column in columns.items()}
        return {task: float(column.mean()) if column.size else float("nan") for task, column in known.items()}


@dataclass(frozen=True)
class Comparison:
    """What finished runs say under one kind of actions.

    Attributes:
        guides: the best first.
        agents: the best first, each followed by what it does when its advice is altered.
    """

    guides: tuple[Group, ...]
    agents: tuple[Group, ...]

    def table(self, against: str | None = None, resamples: int = 2000, seed: int = 0) -> list[dict[str, Any]]:
        """One row a driver, guides first.

        Args:
            against: label of the agent over which improvement is reported, or "guide" for each agent's own.
            resamples: of the bootstrap.
            seed: of the bootstrap.
        """
        rows = []
        for group in (*self.guides, *self.agents):
            low, high = stratified_bootstrap(group.scores, resamples=resamples, seed=seed)
            means = group.means()
            rows.append({
                "driver": group.name, "advice": group.advice, "guide": group.guide.name if group.guide else None,
                "seeds": group.seeds, "iqm": group.iqm, "low": low, "high": high, "mean": means.pop("reward"),
                **means, "improvement": self._improvement(group, against), "needs_guide": group.needs_guide,
                **{PER_STEP + task: reward for task, reward in group.per_step.items()},
            })  # fmt: skip
        return rows

    def track_table(self) -> list[dict[str, Any]]:
        """One row a driver and track."""
        return [
            {"driver": group.name, "advice": group.advice, "seeds": group.seeds, "track": track} | group.means(place)
            for group in (*self.guides, *self.agents)
            for place, track in enumerate(group.tracks)
        ]

    def _improvement(self, group: Group, against: str | None) -> float | None:
        others = {other.name: other for other in self.agents if not other.advice}
        other = group.guide if against == GUIDE else others.get(against or "")
        if other is None or other is group or other.tracks != group.tracks:
            return None
        return probability_of_improvement(group.scores, other.scores)


def compare(runs: Sequence[Run], actions: str = "deterministic") -> Comparison:
    """Group the finished runs among some.

    Args:
        runs: at least one of them finished.
        actions: "deterministic" or "sampled", of the agents; a guide drives in one way only.

    Raises:
        UserError: if two runs are the same seed of one label, or runs of one label drove different tracks.
    """
    labels = dict.fromkeys(run.label for run in runs if run.finished)
    of_label = {label: [run for run in runs if run.finished and run.label == label] for label in labels}
    for label, alike in of_label.items():
        _check_seeds(label, alike)
    guides = _guides(of_label)
    agents: list[Group] = []
    for label, alike in of_label.items():
        drives = [(run.seed, drive) for run in alike for drive in run.drives]
        agent = [(seed, drive) for seed, drive in drives if not drive.is_guide and drive.actions == actions]
        variants = []
        for advice in dict.fromkeys(drive.advice for _, drive in agent):
            seeds, of_advice = zip(*[(seed, drive) for seed, drive in agent if drive.advice == advice], strict=True)
            variants.append(
                Group(
                    label, advice, *_stack(label, of_advice), guide=next(iter(guides.get(label, ())), None),
                    needs_guide=None if advice else alike[0].needs_guide, seed_numbers=seeds,
                )
            )  # fmt: skip
        agents += sorted(variants, key=lambda group: (group.advice != "", -group.iqm))
    own = {group.name: group.iqm for group in reversed(agents)}  # the first of each label: its advice is not altered
    agents.sort(key=lambda group: (-own[group.name], group.name))
    different = {id(group): group for of_label in guides.values() for group in of_label}
    return Comparison(tuple(sorted(different.values(), key=lambda group: -group.iqm)), tuple(agents))


def _check_seeds(label: str, runs: Sequence[Run]) -> None:
    first: dict[int, Run] = {}
    for run in runs:
        if run.seed in first:
            raise UserError(
                f"{first[run.seed].folder} and {run.folder} are both seed {run.seed} of {label}; "
                "take one out of the folder, or give runs that differ labels of their own (coil-train label=TEXT)"
            )
        first[run.seed] = run


def _stack(name: str, drives: Sequence[Drive]) -> tuple[tuple[str, ...], Array, tuple[str, ...]]:
    tracks, tasks = drives[0].tracks, drives[0].tasks
    for drive in drives:
        if drive.tracks != tracks:
            raise UserError(
                f"runs of {name} drove different tracks ({', '.join(tracks)}, and {', '.join(drive.tracks)}); "
                "judge them on the same ones, or give them labels of their own (coil-train label=TEXT)"
            )
        if drive.tasks != tasks:
            raise UserError(
                f"runs of {name} had different tasks ({', '.join(tasks) or 'none'}, and "
                f"{', '.join(drive.tasks) or 'none'}); give them labels of their own (coil-train label=TEXT)"
            )
    return tracks, np.stack([drive.values for drive in drives]), tasks


def _guides(of_label: dict[str, list[Run]]) -> dict[str, list[Group]]:
    """From label to its guides, the best first.

    Labels whose guides drove alike share one, and each different drive of it counts once. A guide that draws at random
    drives otherwise with every seed. Then labels share it whose seeds all drove alike, as far as both have them.
    """
    families: dict[str, list[tuple[list[str], dict[Any, Drive]]]] = {}
    for label, runs in of_label.items():
        driven = [drive for run in runs for drive in run.drives if drive.is_guide]
        for driver in dict.fromkeys(drive.driver for drive in driven):
            drives = {
                (drive.tracks, *np.round(drive.values[:, 0], 3)): drive for drive in driven if drive.driver == driver
            }
            alike = families.setdefault(driver, [])
            family = next((f for f in alike if f[1].keys() <= drives.keys() or drives.keys() <= f[1].keys()), None)
            if family is None:
                alike.append(([label], drives))
            else:
                family[0].append(label)
                family[1].update(drives)
    groups: dict[str, list[Group]] = {}
    for driver, alike in families.items():
        for labels, drives in alike:
            name = driver if len(alike) == 1 else f"{driver} ({_listed(labels)})"
            group = Group(name, "", *_stack(f"the guide of {labels[0]}", list(drives.values())), is_guide=True)
            for label in labels:
                groups.setdefault(label, []).append(group)
    return {label: sorted(of_label, key=lambda group: -group.iqm) for label, of_label in groups.items()}


def _listed(labels: Sequence[str]) -> str:
    if len(labels) <= NAMED + 1:
        return ", ".join(labels)
    return f"{', '.join(labels[:NAMED])} and {len(labels) - NAMED} more"
