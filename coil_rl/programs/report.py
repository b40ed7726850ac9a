"""`coil-report`: the finished runs of a folder in one table and two pictures."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig

from coil_rl.errors import UserError, did_you_mean
from coil_rl.files import write_text
from coil_rl.programs import app
from coil_rl.report import Interval, draw_curve_grid, draw_intervals, draw_learning_curves, page, write_csv
from coil_rl.report.comparison import Comparison, compare
from coil_rl.report.runs import GUIDE, Run, read_runs
from coil_rl.report.statistics import iqm
from coil_rl.train.check import check_values

ACTIONS = {"deterministic": ("deterministic",), "sampled": ("sampled",), "both": ("deterministic", "sampled")}
USUAL = "ppo"  # what improvement is over, unless it is said
IN_ONE_PICTURE = 8  # learning curves
LIMITS = {"resamples": (1, 10**6), "seed": (0, 2**63 - 1)}


def report(config: DictConfig) -> None:
    """Compare what has finished; print the page and leave it in the first folder, with all numbers and the pictures."""
    folders = _folders(config)
    runs = read_runs(folders)
    finished = [run for run in runs if run.finished]
    if not finished:
        raise UserError(
            f"none of the runs in folder={config.folder} is finished; go on with "
            f"coil-train resume={runs[0].folder}, or give the command again that began them"
        )
    found = {actions: compare(finished, actions) for actions in ACTIONS[config.actions]}
    against = _against(config.against, found)
    tables = {actions: of_kind.table(against, config.resamples, config.seed) for actions, of_kind in found.items()}
    parts = [page.section(f"{kind.capitalize()} actions", found[kind], tables[kind], against) for kind in found]
    parts += [*page.learning(finished), *page.guides_that_learned(finished)]
    text = "\n\n".join([*parts, page.notes(config.resamples, against), page.progress(len(finished), len(runs))])

    folder = folders[0]
    write_text(folder / "report.md", text)
    tracks = {actions: of_kind.track_table() for actions, of_kind in found.items()}
    for name, by_actions in {"report.csv": tables, "report_tracks.csv": tracks}.items():
        rows = [{"actions": actions} | row for actions, of_kind in by_actions.items() for row in of_kind]
        write_csv(rows, folder / name)
    draw_intervals({f"{kind} actions": _intervals(found[kind], tables[kind]) for kind in found}, folder / "report.png")
    _draw_curves(finished, next(iter(found.values())), folder / "report_curves.png")
    print(f"{text}\nreport: see {folder}")


def _intervals(found: Comparison, rows: Sequence[Mapping[str, Any]]) -> list[Interval]:
    """The agents, each with its guide as a line; or the guides, where there is no agent."""
    return [
        Interval(
            group.title,
            row["iqm"],
            row["low"],
            row["high"],
            points=[float(score) for score in iqm(group.scores, axis=1)] if len(group.scores) > 1 else [],
            guide=group.guide.iqm if group.guide else None,
            hollow=bool(group.advice),
        )
        for group, row in zip((*found.guides, *found.agents), rows, strict=True)
        if not group.is_guide or not found.agents
    ]


def _draw_curves(runs: Sequence[Run], found: Comparison, path: Path) -> None:
    """The learning curves in the order of the table, if anything was learned."""
    curves: dict[str, list[Any]] = {}
    guides: dict[str, float] = {}
    for label in dict.fromkeys(group.name for group in found.agents):
        learned = [run for run in runs if run.label == label and run.curve]
        returns = [max(run.guide_returns.values()) for run in learned if run.guide_returns]
        curves |= {label: [run.curve for run in learned]} if learned else {}
        guides |= {label: float(np.mean(returns))} if returns else {}
    several = len({round(value, 3) for value in guides.values()}) > 1
    if several or len(curves) > IN_ONE_PICTURE:
        draw_curve_grid(curves, path, guides=guides)
    elif curves:
        draw_learning_curves(curves, path, guides={GUIDE: next(iter(guides.values()))} if guides else {})


def _against(asked: str | None, found: Mapping[str, Comparison]) -> str | None:
    labels = sorted({group.name for of_kind in found.values() for group in of_kind.agents})
    if asked is None:
        return USUAL if USUAL in labels else None
    known = [*labels, GUIDE]
    if asked not in known:
        there_are = f"there are {', '.join(known)}{did_you_mean(asked, known)}"
        raise UserError(f"against={asked} is no label of a finished run; {there_are}")
    return asked


def _folders(config: DictConfig) -> list[Path]:
    given = list(config.folder) if isinstance(config.folder, ListConfig) else [config.folder]
    if not given or not all(isinstance(folder, str) and folder for folder in given):
        raise UserError(f"folder={config.folder} must be a folder, or a list of them: folder=[ONE,OTHER]")
    return [Path(folder).expanduser() for folder in given]


def check(config: DictConfig) -> None:
    """Refuse a configuration of which no report can be made.

    Raises:
        UserError: in one sentence, what is wrong.
    """
    check_values(config)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise UserError("a report is made once; leave out -m, and give several folders as folder=[ONE,OTHER]")
    if config.actions not in ACTIONS:
        raise UserError(
            f"actions={config.actions} must be one of {', '.join(ACTIONS)}{did_you_mean(config.actions, ACTIONS)}"
        )
    for key, (low, high) in LIMITS.items():
        if not low <= config[key] <= high:
            raise UserError(f"{key}={config[key]} must be between {low} and {high}")
    first = _folders(config)[0]
    if first.is_dir() and not os.access(first, os.W_OK):
        raise UserError(f"nothing can be written to {first}; put a folder of yours first: folder=[YOURS,{first}]")


def main() -> None:
    """Entry point."""
    app.run(report, "report", check)


if __name__ == "__main__":
    main()
