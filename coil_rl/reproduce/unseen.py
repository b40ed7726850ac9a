"""Table 5 of the paper: every driver on unseen tracks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.report import Interval, draw_intervals, markdown_table, write_csv
from coil_rl.report.comparison import Group, Paired, compare, paired
from coil_rl.report.runs import DRIVER, GUIDE, MEASURES, Run
from coil_rl.report.statistics import iqm
from coil_rl.reproduce import pages
from coil_rl.reproduce.result import NO_RUNS, Runs, WorldsResult

Row = Mapping[str, Any]

ACTIONS = ("sampled", "deterministic")
# Means over three unseen tracks, lap time in s; no driver crashed.
PAPER_UNSEEN = {
    "guide": {"lap_time": 48.81, "smoothness": 0.121, "reward": 609.4},
    "oil": {"lap_time": 48.82, "smoothness": 0.061, "reward": 620.8},
    "ppo": {"lap_time": 48.58, "smoothness": 0.557, "reward": 614.5},
    "coil": {"lap_time": 48.48, "smoothness": 0.606, "reward": 632.9},
}
MEASURE_COLUMNS = {"lap_time": ("lap (s)", ".2f"), "smoothness": ("smoothness", ".3f"), "reward": ("reward", ".1f")}
MAX_TRACK_COLUMNS = 8

# The paper's claims: text, measure, driver, driver to compare with, and 1 if the first has more of it, else -1.
CLAIMS = (
    ("COIL earns more than its guide", "reward", "coil", "guide", 1),
    ("COIL earns more than PPO", "reward", "coil", "ppo", 1),
    ("COIL earns more than imitation (OIL)", "reward", "coil", "oil", 1),
    ("PPO earns more than the guide", "reward", "ppo", "guide", 1),
    ("COIL's laps take less time than PPO's", "lap_time", "coil", "ppo", -1),
    ("COIL steers less smoothly than its guide", "smoothness", "coil", "guide", 1),
    ("COIL earns more with its guide's advice than with another car's", "reward", "coil", "coil_shuffled", 1),
)

NOTES = """
Completed: share of seeds and tracks on which both laps were finished; all else is the mean over seeds and tracks. IQM:
the mean of the middle half of the rewards. Reward - {against}'s: of the same seed on the same track; better: the share
of seeds and tracks with more. Intervals: percentile bootstrap of whole seeds, {resamples} resamples; with five seeds
they contain the mean in about 85 of 100 cases. The paper drove with sampled actions, here several episodes a track;
deterministic actions are the mode. Drivers with only one kind of actions, as imitations and the guide, are in both
tables."""


class Table5(WorldsResult):
    """Lap time, smoothness, reward and crashes of each driver on unseen tracks."""

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        parts, episodes, worlds = ["## Table 5: unseen tracks"], [], {}
        for world, experiments in self.worlds.items():
            of_world = [run for experiment in experiments for run in runs[experiment]]
            episodes += [{"world": world} | row for run in of_world for row in _episodes(run)]
            groups = worlds[world] = {actions: self._drivers(of_world, actions) for actions in ACTIONS}
            rows = {actions: [self._row(group, groups[actions]) for group in groups[actions]] for actions in ACTIONS}
            parts += pages.world_heading(world)
            if not world:
                parts.append(_paper_table(rows))
                panels = {f"{actions} actions": _intervals(groups[actions], rows[actions]) for actions in ACTIONS}
                title = "Table 5: unseen tracks"
                draw_intervals(panels, stem.with_suffix(".png"), measure="reward (mean)", title=title)
            for actions in ACTIONS:
                parts += [f"**{actions.capitalize()} actions**", self._driver_table(rows[actions])]
                parts += [] if world else [_track_table(groups[actions], stem.name)]
        write_csv(episodes, stem.with_suffix(".csv"))
        notes = NOTES.strip().format(against=self.against, resamples=self.resamples)
        return "\n\n".join([*parts, notes, self._claims(worlds)])

    def _drivers(self, runs: Sequence[Run], actions: str) -> list[Group]:
        """Return the guide, then the agents by reward; agents with only deterministic actions are always included."""
        agents: dict[str, Group] = {}
        comparison, deterministic = compare(runs, actions), compare(runs, "deterministic")
        for group in (*comparison.agents, *deterministic.agents):
            if not group.advice:
                agents.setdefault(group.name, group)
        guide = (agents[self.against].guide if self.against in agents else None) or comparison.guides[0]
        ranked = sorted(agents.values(), key=lambda group: -group.scores.mean())
        return [dataclasses.replace(guide, name=GUIDE), *ranked]

    def _row(self, group: Group, groups: Sequence[Group]) -> dict[str, Any]:
        """Return the measures of a driver, and its comparison with the guide and with `against`."""
        row: dict[str, Any] = {"driver": group.name, "seeds": group.seeds, **group.means()}
        row |= self.estimate("reward", group.scores, np.mean) | self.estimate("iqm", group.scores, iqm)
        others = {other.name: other for other in groups if other.name != group.name}
        row |= {"difference": None, "better": None, "over_guide": None}
        if group.is_guide:
            return row
        if self.against in others and (pairs := self._paired(group, others[self.against])):
            row |= {"difference": pages.with_interval(*pairs.difference, "+.1f"), "better": pairs.better[0]}
        if pairs := self._paired(group, others[GUIDE]):
            row["over_guide"] = pairs.better[0]
        return row

    def _paired(self, group: Group, other: Group, measure: str = "reward") -> Paired | None:
        return paired(group, other, measure, resamples=self.resamples, seed=self.seed)

    def _driver_table(self, rows: Sequence[Row]) -> str:
        return markdown_table(rows, {
            "driver": ("driver", ""), "seeds": ("seeds", ""), "completed": ("completed", ".0%"),
            "crashed": ("crashed", ".0%"), "lap_time": ("lap (s)", ".2f"), "smoothness": ("smoothness", ".3f"),
            "reward cell": ("reward: mean (95 %)", ""), "iqm cell": ("reward: IQM (95 %)", ""),
            "difference": (f"reward - {self.against}'s (95 %)", ""), "better": (f"better than {self.against}", ".0%"),
            "over_guide": ("better than the guide", ".0%"),
        })  # fmt: skip

    def _claims(self, worlds: Mapping[str, Mapping[str, Sequence[Group]]]) -> str:
        """Return the verdicts in all worlds; in variants of the main world only those on the reward."""
        rows: list[dict[str, Any]] = []
        for world, by_actions in worlds.items():
            for claim, measure, driver, other, sign in CLAIMS:
                cells = {}
                for actions, groups in by_actions.items():
                    by_name = {group.name: group for group in groups}
                    if driver in by_name and other in by_name and (measure == "reward" or not world):
                        pairs = self._paired(by_name[driver], by_name[other], measure)
                        spec = f"+{MEASURE_COLUMNS[measure][1]}"
                        cells[actions] = pages.verdict(*pairs.difference, spec, sign) if pairs else None
                if cells:
                    paper = _paper_difference(measure, driver, other)
                    rows.append({"claim": f"{claim}, {world}" if world else claim, "paper": paper} | cells)
        crashes: dict[str, str] = {"claim": "Nobody crashes", "paper": "0%"}
        for actions, groups in worlds[""].items():
            shares = {group.name: group.means()["crashed"] for group in groups if group.name in PAPER_UNSEEN}
            details = ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
            crashes[actions] = pages.certain_verdict(not any(shares.values()), details)
        headings = {"paper": "paper"} | {actions: f"ours, {actions} actions (95 %)" for actions in ACTIONS}
        return pages.claims_section([*rows, crashes], headings)


def _paper_table(rows: Mapping[str, Sequence[Row]]) -> str:
    """Return the table of the paper's drivers next to the paper, given the rows of the drivers by actions."""
    table: list[dict[str, Any]] = []
    for driver, paper in PAPER_UNSEEN.items():
        learned = driver in ("ppo", "coil")
        for actions in ACTIONS if learned else ACTIONS[:1]:
            by_name = {row["driver"]: row for row in rows[actions]}
            if row := by_name.get(driver):
                ratios = {
                    "ratio": row["reward"] / by_name[GUIDE]["reward"],
                    "paper ratio": paper["reward"] / PAPER_UNSEEN[GUIDE]["reward"],
                }
                values = {f"paper {measure}": value for measure, value in paper.items()} | ratios
                table.append({**row, **values, "actions": actions if learned else "the same", "paper crashed": 0.0})
    columns = {"driver": ("driver", ""), "actions": ("actions", "")}
    ratio = {"ratio": ("reward / guide's", ".3f"), "crashed": ("crashed", ".0%")}
    for key, (heading, spec) in {**MEASURE_COLUMNS, **ratio}.items():
        columns |= {key: (heading, spec), f"paper {key}": ("paper", spec)}
    return markdown_table(table, columns)


def _track_table(groups: Sequence[Group], name: str) -> str:
    """Return the mean reward by driver and track, with the completed share where it is below 1."""
    tracks = groups[0].tracks
    if len(tracks) > MAX_TRACK_COLUMNS:
        return f"The numbers of each of the {len(tracks)} tracks are in {name}.csv."
    rows = []
    for group in groups:
        row = {"driver": group.name}
        for index, track in enumerate(tracks):
            means = group.means(index)
            share = f" ({means['completed']:.0%} completed)" if means["completed"] < 1 else ""
            row[track] = f"{means['reward']:.1f}{share}"
        rows.append(row)
    return markdown_table(rows, {"driver": ("mean reward", "")} | {track: (track, "") for track in tracks})


def _paper_difference(measure: str, driver: str, other: str) -> str | None:
    if driver not in PAPER_UNSEEN or other not in PAPER_UNSEEN:
        return None
    return f"{PAPER_UNSEEN[driver][measure] - PAPER_UNSEEN[other][measure]:+{MEASURE_COLUMNS[measure][1]}}"


def _episodes(run: Run) -> list[dict[str, Any]]:
    """Return the CSV rows of a run, one per driver and track."""
    rows = run.evaluation[[*DRIVER, *MEASURES]].to_dict("records")
    return [{"label": run.label, "seed": run.seed} | row for row in rows]


def _intervals(groups: Sequence[Group], rows: Sequence[Row]) -> list[Interval]:
    guide = float(groups[0].scores.mean())
    return [
        Interval(
            group.name, row["reward"], row["reward_low"], row["reward_high"], guide=guide,
            points=[float(score) for score in group.scores.mean(axis=1)] if len(group.scores) > 1 else [],
        )
        for group, row in zip(groups, rows, strict=True)
        if not group.is_guide
    ]  # fmt: skip
