"""`coil-report`: tables and figures of the finished runs in a folder."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, ListConfig

from coil_rl.errors import UserError, did_you_mean
from coil_rl.programs import app

if TYPE_CHECKING:
    from coil_rl.report.comparison import Comparison
    from coil_rl.report.runs import Run

ACTIONS = {
    "deterministic": ("deterministic",),
    "sampled": ("sampled",),
    "both": ("deterministic", "sampled"),
}
DEFAULT_AGAINST = "ppo"
MAX_CURVES = 8  # in one plot


def report(config: DictConfig) -> None:
    """Compare the finished runs, and print the page.

    The page, all numbers and the figures are written to the first folder.
    """
    from coil_rl.files import write_text
    from coil_rl.report import page, write_csv
    from coil_rl.report.comparison import compare
    from coil_rl.report.configurations import distinguish
    from coil_rl.report.runs import failed_jobs, read_runs

    folders = _folders(config)
    runs = read_runs(folders)
    finished = [run for run in runs if run.finished]
    if not finished:
        raise UserError(
            f"none of the runs in folder={config.folder} is finished; "
            f"continue one with coil-train resume={runs[0].folder}, "
            "or repeat the command that started them"
        )
    finished, differences = distinguish(finished)
    compared = {actions: compare(finished, actions) for actions in ACTIONS[config.actions]}
    against = _against(config.against, compared)
    tables = {kind: compared[kind].table(against) for kind in compared}
    parts = []
    for kind, comparison in compared.items():
        heading = f"{kind.capitalize()} actions"
        parts.append(page.section(heading, comparison, tables[kind], against))
    parts += [*page.training(finished), *page.guide_training(finished)]
    normalised = any(comparison.normalised for comparison in compared.values())
    parts.append(page.notes(against, normalised, "sampled" in compared))
    parts += page.handed_over(finished)
    parts += differences
    parts.append(page.progress(len(finished), len(runs), failed_jobs(folders)))
    text = "\n\n".join(parts)

    folder = folders[0]
    write_text(folder / "report.md", text)
    write_csv(_rows(tables), folder / "report.csv")
    cases = {kind: comparison.case_table() for kind, comparison in compared.items()}
    write_csv(_rows(cases), folder / "report_cases.csv")
    _draw_scores(compared, normalised, folder / "report.png")
    _draw_curves(finished, next(iter(compared.values())), folder / "report_curves.png")
    print(f"{text}\nreport: see {folder}")


def _rows(tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return the rows of the tables for each kind of actions as one table."""
    rows = []
    for actions, table in tables.items():
        rows += [{"actions": actions, **row} for row in table]
    return rows


def _draw_scores(compared: Mapping[str, Comparison], normalised: bool, path: Path) -> None:
    """Draw the scores of the agents, or of the guides if there is no agent."""
    from coil_rl.report import draw_intervals, driver_intervals

    panels = {}
    for kind, comparison in compared.items():
        panels[f"{kind} actions"] = driver_intervals(comparison.agents or comparison.guides)
    measure = "reward / guide's (mean)" if normalised else "reward (mean)"
    draw_intervals(panels, path, measure=measure)


def _draw_curves(runs: Sequence[Run], comparison: Comparison, path: Path) -> None:
    """Draw the learning curves in the order of the table, if anything was trained."""
    from coil_rl.report import draw_curve_grid, draw_learning_curves

    curves: dict[str, list[Any]] = {}
    guides: dict[str, float] = {}
    for label in dict.fromkeys(group.name for group in comparison.agents):
        trained = [run for run in runs if run.label == label and run.curve]
        returns = [max(run.guide_returns.values()) for run in trained if run.guide_returns]
        if trained:
            curves[label] = [run.curve for run in trained]
        if returns:
            guides[label] = sum(returns) / len(returns)
    several_guides = len({round(value, 3) for value in guides.values()}) > 1
    if several_guides or len(curves) > MAX_CURVES:
        draw_curve_grid(curves, path, guides=guides)
    elif curves:
        guide = {"guide": next(iter(guides.values()))} if guides else {}
        sizes = {_cases_of_curve(run) for run in runs if run.curve}
        cases = sizes.pop() if len(sizes) == 1 else None
        draw_learning_curves(curves, path, guides=guide, cases=cases)


def _cases_of_curve(run: Run) -> int | None:
    """Return the number of cases of the curve of a run; None if its configuration has none."""
    curve = (run.settings.get("evaluation") or {}).get("curve") or {}
    count = curve.get("num_envs")
    return count if isinstance(count, int) else None


def _against(given: str | None, compared: Mapping[str, Comparison]) -> str | None:
    """Return the label for the column `better than`; None for no such column."""
    labels = sorted({group.name for comparison in compared.values() for group in comparison.agents})
    if given is None:
        return DEFAULT_AGAINST if DEFAULT_AGAINST in labels else None
    choices = [*labels, "guide"]
    if given not in choices:
        raise UserError(
            f"against={given} is no label of a finished run; "
            f"there are {', '.join(choices)}{did_you_mean(given, choices)}"
        )
    return given


def _folders(config: DictConfig) -> list[Path]:
    """Return the folders with runs, at least one."""
    given = list(config.folder) if isinstance(config.folder, ListConfig) else [config.folder]
    if not given or not all(isinstance(folder, str) and folder for folder in given):
        raise UserError(
            f"folder={config.folder} must be a folder, or a list of them: folder=[ONE,OTHER]"
        )
    return [Path(folder).expanduser() for folder in given]


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from coil_rl.config.values import check_values

    check_values(config)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise app.NoSweepError(
            "a report covers several folders at once; leave out -m and write folder=[ONE,OTHER]"
        )
    first = _folders(config)[0]
    if first.is_dir() and not os.access(first, os.W_OK):
        raise UserError(
            f"folder={first} is not writable; put a writable folder first: folder=[YOURS,{first}]"
        )


main = partial(app.run_program, report, "report", check)

if __name__ == "__main__":
    main()
