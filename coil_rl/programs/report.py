"""`coil-report`: tables and figures of the finished runs in a folder."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, ListConfig

from coil_rl.config.folder import PREFIX
from coil_rl.errors import UserError, did_you_mean
from coil_rl.programs import app
from coil_rl.programs.sweeps import is_sweep

if TYPE_CHECKING:
    from coil_rl.report.comparison import Comparison
    from coil_rl.report.html import Section

ACTIONS = {
    "deterministic": ("deterministic",),
    "sampled": ("sampled",),
    "both": ("deterministic", "sampled"),
}
DEFAULT_AGAINST = "ppo"


def report(config: DictConfig) -> None:
    """Compare the finished runs, and print the page.

    The page, as Markdown and as HTML with the figures, all numbers and the figures are written to
    the first folder.
    """
    from coil_rl.files import write_text
    from coil_rl.report import page, write_csv
    from coil_rl.report.comparison import compare
    from coil_rl.report.configurations import (
        distinguish,
        of_several_conditions,
        of_several_definitions,
        of_several_envs,
    )
    from coil_rl.report.figures import draw_report
    from coil_rl.report.guides import of_changed_guides, of_guides_of_labels
    from coil_rl.report.html import Section, html_page
    from coil_rl.report.runs import failed_jobs, read_runs
    from coil_rl.run.stopping import resume_command

    folders = _folders(config)
    runs = read_runs(folders)
    finished = [run for run in runs if run.finished]
    if not finished:
        raise UserError(
            f"none of the runs in folder={config.folder} is finished; "
            f"continue one with {resume_command(runs[0].folder)}, "
            "or repeat the command that started them"
        )
    finished, differences = distinguish(finished)
    compared = {actions: compare(finished, actions) for actions in ACTIONS[config.actions]}
    against = _against(config.against, compared)
    tables = {kind: compared[kind].table(against) for kind in compared}
    sections = [
        Section(f"{kind.capitalize()} actions", page.section(compared[kind], rows, against))
        for kind, rows in tables.items()
    ]
    notes = [
        *page.notes(against, compared),
        *page.unpaired(against, compared),
        *page.handed_over(finished),
        *page.begun(finished),
        *of_several_envs(finished),
        *of_several_conditions(finished),
        *of_several_definitions(finished),
        *differences,
        *of_changed_guides(finished),
        *of_guides_of_labels(finished),
        *page.progress(len(finished), len(runs), failed_jobs(folders)),
    ]
    training = [*page.training(finished), *page.guide_training(finished)]
    sections.append(Section("", [*training, *notes]))
    text = "\n\n".join(map(_markdown, sections))

    folder = folders[0]
    write_text(folder / "report.md", text)
    write_csv(_rows(tables), folder / "report.csv")
    cases = {kind: comparison.case_table() for kind, comparison in compared.items()}
    write_csv(_rows(cases), folder / "report_cases.csv")
    figures = draw_report(finished, compared, folder)
    html = html_page(f"Report of {folder.resolve().name}", sections, figures)
    write_text(folder / "report.html", html)
    print(f"{text}\nreport: see {folder}")


def _markdown(section: Section) -> str:
    heading = [f"## {section.heading}"] if section.heading else []
    return "\n\n".join([*heading, *map(str, section.blocks)])


def _rows(tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Return the rows of the tables for each kind of actions as one table."""
    rows = []
    for actions, table in tables.items():
        rows += [{"actions": actions, **row} for row in table]
    return rows


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
    for folder in given:
        if folder.startswith(PREFIX):
            raise UserError(
                f"folder={folder}: a report is about folders with runs; evaluate a shipped policy "
                f"by coil-evaluate run={folder}"
            )
    return [Path(folder).expanduser() for folder in given]


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    from coil_rl.config.values import check_values

    check_values(config)
    app.check_folder("folder")
    if is_sweep():
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
