"""`coil-report`: tables and figures of the finished runs in a folder."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from coil_rl.config.folder import PREFIX
from coil_rl.errors import UserError, did_you_mean
from coil_rl.output import printable
from coil_rl.programs import app

if TYPE_CHECKING:
    from coil_rl.report.comparison import Comparison
    from coil_rl.report.html import Section
    from coil_rl.report.runs import Run
    from coil_rl.report.style import Stroke

ACTIONS = {
    "deterministic": ("deterministic",),
    "sampled": ("sampled",),
    "both": ("deterministic", "sampled"),
}
DEFAULT_AGAINST = "ppo"  # without a guide
GUIDE = "guide"  # of each agent


@dataclass(frozen=True)
class EnvPart:
    """What a report has of the runs in one env.

    Args:
        env: name, for headings and files; empty where there is only one env.
        runs: finished, with the labels that are shown.
        differing: what differs between runs whose label got a number.
        compared: the policies, by kind of actions.
        against: what they are compared with.
    """

    env: str
    runs: Sequence[Run]
    differing: Sequence[Mapping[str, str]]
    compared: Mapping[str, Comparison]
    against: str | None

    def sections(self, folder: Path, strokes: Mapping[str, Stroke], kind: str) -> list[Section]:
        """Return the sections, the figures in the first one; the figures are written, too.

        Args:
            folder: for the figures.
            strokes: by label.
            kind: of their files, such as "png".
        """
        from coil_rl.report import page
        from coil_rl.report.figures import draw_report
        from coil_rl.report.html import Section

        suffix = re.sub(r"[^\w.-]+", "_", f"_{self.env}") if self.env else ""
        figures = draw_report(self.runs, self.compared, folder, strokes, f"{suffix}.{kind}")
        sections: list[Section] = []
        for actions, comparison in self.compared.items():
            heading = f"{actions} actions"
            heading = f"{self.env}, {heading}" if self.env else heading.capitalize()
            blocks = page.section(comparison, self.against)
            if not sections:
                blocks += page.what_differs(self.differing, "policy")
            sections.append(Section(heading, blocks, [] if sections else figures))
        training = [*page.training(self.runs), *page.guide_training(self.runs)]
        return [*sections, Section("", [*training, *self._notes()])]

    def curves(self) -> list[dict[str, Any]]:
        """Return a row for each point of the learning curve of each run."""
        from coil_rl.report.curves import points
        from coil_rl.report.runs import RETURN

        rows = []
        for run in self.runs:
            named = {"env": self.env, "label": run.label, "seed": run.seed}
            found = points(run.curve, RETURN).tolist() if run.curve else []
            rows += [named | {"frames": frames, "return": value} for frames, value in found]
        return rows

    def _notes(self) -> list[str]:
        """Return the sentences on these runs."""
        from coil_rl.report import page
        from coil_rl.report.configurations import of_several_conditions, of_several_definitions
        from coil_rl.report.guides import of_changed_guides, of_guides_of_labels

        return [
            *page.unpaired(self.against, self.compared),
            *page.handed_over(self.runs),
            *page.begun(self.runs),
            *of_several_conditions(self.runs),
            *of_several_definitions(self.runs),
            *of_changed_guides(self.runs),
            *of_guides_of_labels(self.runs),
        ]


def _continuing(run: Run) -> str:
    """Return the command that continues a run."""
    from coil_rl.config.trust import to_trust
    from coil_rl.run.stopping import resume_command

    return resume_command(run.folder, to_trust(OmegaConf.create({**run.settings})))


def report(config: DictConfig) -> None:
    """Compare the finished runs, and print the page.

    Runs are compared within an env and its test. The page, as Markdown and as HTML with the
    figures, all numbers and the figures are written to the first folder.
    """
    from coil_rl.files import write_text
    from coil_rl.programs.sweeps import unstarted_jobs
    from coil_rl.report import page, style, write_csv
    from coil_rl.report.html import Section, html_page
    from coil_rl.report.runs import failed_jobs, read_runs
    from coil_rl.report.sentences import REPORT

    folders = _folders(config)
    runs = read_runs(folders)
    finished = [run for run in runs if run.finished]
    if not finished:
        raise UserError(
            f"none of the runs in folder={config.folder} is finished; "
            f"continue one with {_continuing(runs[0])}, "
            "or repeat the command that started them"
        )
    parts, envs = _parts(finished, ACTIONS[config.actions], config.against)
    against = parts[0].against
    compared = [comparison for part in parts for comparison in part.compared.values()]
    drawn = [group for comparison in compared for group in comparison.agents or comparison.guides]
    strokes = style.strong_strokes(dict.fromkeys(group.name for group in drawn))
    folder = folders[0]
    first = {part.env: next(iter(part.compared.values())).table(against) for part in parts}
    overview = [*page.summary(first, against), *page.what_differs(envs, "env")]
    sections = [Section("", overview)] if overview else []
    for part in parts:
        sections += part.sections(folder, strokes, config.figures)
    sections.append(
        Section(
            "",
            [
                *page.notes(against, sampled="sampled" in ACTIONS[config.actions]),
                *REPORT.said(
                    "progress",
                    finished=len(finished),
                    started=len(runs),
                    refused=failed_jobs(folders),
                    unstarted=unstarted_jobs(folders, [run.folder for run in runs]),
                ),
            ],
        )
    )
    text = "\n\n".join(filter(None, map(_markdown, sections)))
    text = "\n".join(map(printable, text.split("\n")))
    write_text(folder / "report.md", text)
    write_csv(_rows(parts, lambda each: each.table(against)), folder / "report.csv")
    write_csv(_rows(parts, lambda each: each.case_table()), folder / "report_cases.csv")
    write_csv([row for part in parts for row in part.curves()], folder / "report_curves.csv")
    write_text(folder / "report.tex", "\n\n".join(filter(None, map(_latex, sections))))
    html = html_page(f"Report of {folder.resolve().name}", sections)
    write_text(folder / "report.html", html)
    print(f"{text}\nreport: see {folder}")


def _parts(
    finished: Sequence[Run], kinds: Sequence[str], given: str | None
) -> tuple[list[EnvPart], list[dict[str, str]]]:
    """Return a part for each env and test, and what differs between those of one env.

    Args:
        kinds: of actions.
        given: what policies are to be compared with; None for the default.
    """
    from coil_rl.report.comparison import compare
    from coil_rl.report.configurations import by_test, distinguish

    of_envs, differ = by_test(finished)
    named = {env: distinguish(runs) for env, runs in of_envs.items()}
    compared = {
        env: {kind: compare(runs, kind) for kind in kinds} for env, (runs, _) in named.items()
    }
    against = _against(given, [each for of in compared.values() for each in of.values()])
    parts = [
        EnvPart(env if len(named) > 1 else "", runs, differing, compared[env], against)
        for env, (runs, differing) in named.items()
    ]
    return parts, differ


def _markdown(section: Section) -> str:
    heading = [f"## {section.heading}"] if section.heading else []
    return "\n\n".join([*heading, *map(str, section.blocks)])


def _latex(section: Section) -> str:
    """Return the tables of a section as LaTeX, for the package booktabs."""
    from coil_rl.report.table import Table

    tables = [block.latex() for block in section.blocks if isinstance(block, Table)]
    return "\n\n".join([f"% {section.heading}", *tables]) if tables else ""


def _rows(
    parts: Sequence[EnvPart], table: Callable[[Comparison], list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """Return the rows of the tables of all envs and kinds of actions as one table."""
    rows = []
    for part in parts:
        for kind, comparison in part.compared.items():
            rows += [{"env": part.env, "actions": kind, **row} for row in table(comparison)]
    return rows


def _against(given: str | None, compared: Sequence[Comparison]) -> str | None:
    """Return what the policies are compared with; None for nothing."""
    agents = [group for comparison in compared for group in comparison.agents]
    labels = sorted({group.name for group in agents})
    if given is None and any(group.guide for group in agents):
        return GUIDE
    if given is None:
        return DEFAULT_AGAINST if DEFAULT_AGAINST in labels else None
    choices = [*labels, GUIDE]
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
    app.check_folder("folder")
    first = _folders(config)[0]
    if first.is_dir() and not os.access(first, os.W_OK):
        raise UserError(
            f"folder={first} is not writable; put a writable folder first: folder=[YOURS,{first}]"
        )


NO_SWEEP = "a report covers several folders at once; leave out -m and write folder=[ONE,OTHER]"
main = partial(app.run_program, report, "report", check, no_sweep=NO_SWEEP)

if __name__ == "__main__":
    main()
