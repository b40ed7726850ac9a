"""Table 5 of the paper: every driver on tracks that it has not seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.report import Interval, draw_intervals, write_csv
from coil_rl.report.comparison import Group, compare, paired
from coil_rl.report.runs import DRIVER, GUIDE, MEASURES, Run
from coil_rl.report.statistics import iqm, stratified_bootstrap
from coil_rl.reproduce.result import NO_RUNS, Runs
from coil_rl.reproduce.table_5_page import beside_the_paper, drivers, held_up, tracks
from coil_rl.reproduce.worlds import OfWorlds, heading

SAMPLED, DETERMINISTIC = "sampled", "deterministic"
STATISTICS: dict[str, Callable[..., Any]] = {"reward": np.mean, "iqm": iqm}

NOTES = """
Completed: share of seeds and tracks on which both laps were finished; all else is the mean over seeds and tracks. IQM:
the mean of the middle half of the rewards. Reward - {against}'s: of the same seed on the same track; better: the share
of seeds and tracks with more. Intervals: percentile bootstrap of whole seeds, {resamples} resamples; with five seeds
they hold the mean in about 85 of 100 cases. Sampled actions are what the paper drove with, here several episodes a
track; deterministic ones are the mode. Drivers that act in one way only, as imitations and the guide do, are in both
tables."""


class Table5(OfWorlds):
    """Laps, smoothness, reward and crashes of each driver on unseen tracks."""

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        parts, numbers, worlds = ["## Table 5: unseen tracks"], [], {}
        for world, experiments in self.worlds.items():
            there = [run for experiment in experiments for run in runs[experiment]]
            numbers += [{"world": world} | row for row in _numbers(there)]
            found = {actions: self._drivers(there, actions) for actions in (SAMPLED, DETERMINISTIC)}
            rows = {actions: [self._row(group, groups) for group in groups] for actions, groups in found.items()}
            parts += heading(world)
            if not world:
                parts.append(beside_the_paper(rows))
                panels = {f"{kind} actions": _intervals(found[kind], rows[kind]) for kind in found}
                draw_intervals(
                    panels, stem.with_suffix(".png"), measure="reward (mean)", title="Table 5: unseen tracks"
                )
            for actions, groups in found.items():
                parts += [f"**{actions.capitalize()} actions**", drivers(rows[actions], self.against)]
                parts += [] if world else [tracks(groups, stem.name)]
            worlds[world] = found
        write_csv(numbers, stem.with_suffix(".csv"))
        notes = NOTES.strip().format(against=self.against, resamples=self.resamples)
        return "\n\n".join([*parts, notes, held_up(worlds, self.resamples, self.seed)])

    def _drivers(self, runs: Sequence[Run], actions: str) -> list[Group]:
        """The guide, as good as it is, and the agents by the reward that they earn."""
        found, others = compare(runs, actions), compare(runs, DETERMINISTIC)
        agents = [group for group in found.agents if not group.advice]
        known = [group.name for group in agents]
        agents += [group for group in others.agents if not group.advice and group.name not in known]
        own = next((group.guide for group in agents if group.name == self.against), None) or found.guides[0]
        guide = dataclasses.replace(own, name=GUIDE)
        return [guide, *sorted(agents, key=lambda group: -group.scores.mean())]

    def _row(self, group: Group, groups: Sequence[Group]) -> dict[str, Any]:
        """What the tables say of a driver."""
        row: dict[str, Any] = {"driver": group.name, "seeds": group.seeds}
        row |= group.means() | {"iqm": group.iqm}
        for name, statistic in STATISTICS.items():
            ends = stratified_bootstrap(group.scores, statistic, resamples=self.resamples, seed=self.seed)
            row |= {f"{name}_low": ends[0], f"{name}_high": ends[1]}
        for name in dict.fromkeys((self.against, GUIDE)):
            other = next((each for each in groups if each.name == name), None)
            if other is not None and group.name not in (name, GUIDE):
                row[name] = paired(group, other, resamples=self.resamples, seed=self.seed)
        return row


def _numbers(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Every drive of every run."""
    rows = [(run, run.evaluation[[*DRIVER, *MEASURES]].to_dict("records")) for run in runs]
    return [{"label": run.label, "seed": run.seed} | row for run, of_run in rows for row in of_run]


def _intervals(groups: Sequence[Group], rows: Sequence[Mapping[str, Any]]) -> list[Interval]:
    guide = float(groups[0].scores.mean())
    return [
        Interval(
            group.name, row["reward"], row["reward_low"], row["reward_high"],
            points=[float(score) for score in group.scores.mean(axis=1)] if len(group.scores) > 1 else [], guide=guide,
        )
        for group, row in zip(groups, rows, strict=True)
        if not group.is_guide
    ]  # fmt: skip
