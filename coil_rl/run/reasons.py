"""What is said of a run: in sentences, and as an interpreter and a notebook show it."""

from __future__ import annotations

import base64
import math
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from coil_rl import record
from coil_rl.files import LARGEST_TABLE, SWEEP, read_file
from coil_rl.learners.anchor import StartTest
from coil_rl.measures import MEAN_CASE, measures_of
from coil_rl.record import DELIVERY, UNTESTED
from coil_rl.report.runs import EVALUATION, RETURN, SELECTION
from coil_rl.report.sentences import Sentences
from coil_rl.report.table import return_format
from coil_rl.run.folder import is_begun
from coil_rl.run.stopping import command_of, resume_command

if TYPE_CHECKING:
    from coil_rl.run.run import Run


SENTENCES = Sentences("coil_rl.run", "evaluation.j2")
RISE = 0.05  # of the range of a curve: a rise of its last quarter that is worth more training
FIRST = "first"  # policy of a run that holds its guide
POLICIES = {
    "last": "the last policy",
    UNTESTED: "the last policy",
    "earlier": "an earlier policy",
    FIRST: "the first policy",
    "tuned": "the tuned guide",
    "best_candidate": "the best candidate",
}


def about_returns(sizes: Mapping[str, int], *, tested: bool = False) -> list[str]:
    """Return what the return of the progress bar, of the curve and of the table counts.

    Args:
        tested: whether a test at the end of the run decides what is handed over.
    """
    others = 0 if tested else sizes.get(SELECTION, 0)
    return SENTENCES.said("about_returns", cases=sizes.get(EVALUATION, 0), others=others)


def start_test(row: Mapping[str, float]) -> list[str]:
    """Return the sentences that say which guide an anchored policy holds; none without a test.

    Args:
        row: of `metrics.csv`, that of the state before the first update.
    """
    guide, opposite, new, cases, weight = (row.get(name, math.nan) for name in StartTest.names)
    if math.isnan(cases):
        return []
    tested = {"the guide": guide, "its opposite": opposite, "the new policy": new}
    known = {name: value for name, value in tested.items() if not math.isnan(value)}
    better = max(known.values()) > new
    return SENTENCES.said("start_test", cases=cases, tested=known, weight=weight, better=better)


def handed_over(folder: Path) -> list[str]:
    """Return the sentences that say what a run handed over and why; none without a test.

    Raises:
        UserError: if the file is damaged.
    """
    report = DELIVERY.read(folder)
    if report is None:
        return []
    if report.policy == UNTESTED:
        return SENTENCES.said("untested")
    names = dict(POLICIES)
    if report.frames is not None:
        names["earlier"] = f"the policy after {report.frames:,} frames"
    title = names.get(report.policy, f"the {report.policy} itself, and nothing that was learned")
    if report.policy == FIRST:
        title += ", which is its guide and has learned nothing"
    spec = return_format(report.returns.values())
    return SENTENCES.said(
        "handed_over",
        title=title,
        is_guide=report.policy not in names and "last" in report.returns,
        cases=report.cases,
        tested={names.get(name, name): value for name, value in report.returns.items()},
        ahead=[f"{value:+{spec}}" for value in report.ahead or ()],
    )


def still_rising(rows: Sequence[Mapping[str, float]]) -> bool:
    """Return whether the return of the kept policies was still rising at the end of a run.

    Args:
        rows: of `metrics.csv`.
    """
    returns = [row[RETURN] for row in rows if not math.isnan(row.get(RETURN, math.nan))]
    quarter = len(returns) // 4
    if quarter < 1:
        return False
    before, last = max(returns[:-quarter]), max(returns[-quarter:])
    return last - before > RISE * (max(returns) - min(returns))


def next_step(
    folder: Path,
    frames: int,
    rows: Sequence[Mapping[str, float]] = (),
    trust: Sequence[str] = (),
    *,
    in_python: bool = False,
) -> str:
    """Return a line with what usually follows a finished training.

    Args:
        rows: of `metrics.csv`.
        trust: packages that commands must trust.
        in_python: whether it is said in Python, not for a shell.
    """
    if in_python:
        steps = ["run.evaluate(cases=100)", "run.controller()", f"run.train(frames={2 * frames})"]
    else:
        swept = (folder.parent / SWEEP).exists()
        report = f"coil-report folder={shlex.quote(str(folder.parent if swept else folder))}"
        longer = f"{resume_command(folder, trust)} budget.frames={2 * frames}"
        steps = [command_of("coil-evaluate", "run", folder, trust), report, longer]
    if still_rising(rows):
        return f"Still rising at the end: {steps[-1]}"
    return f"Next: {' | '.join(steps)}"


def line_of(run: Run) -> str:
    """Return what a run is, and how far it is."""
    rows = [row for row in _means(run) if row["driver"] == run.label]
    state = "begun" if is_begun(run.folder) else "new"
    if _means(run):
        state = "finished"
    if rows:
        reward = rows[0]["reward"]
        state += f" with return {reward:{return_format([reward])}}"
    frames = f"{run.budget.frames:,} frames, " if run.has_agent else ""
    return f"<Run {run.label}, seed {run.seed}, {frames}{state}, in {run.folder}>"


def page_of(run: Run) -> str:
    """Return the line as HTML, with the means of the evaluation and the learning curve."""
    import pandas as pd  # a training does without it

    parts, rows = [f"<p>{escape(line_of(run))}</p>"], _means(run)
    if rows:
        measures = measures_of((run.settings.get("evaluation") or {}).get("measures") or {})
        titles = {name: text for name, each in measures.items() if (text := each.heading(name))}
        counts = [name for name in rows[0] if name.endswith("episodes") and name not in measures]
        columns = ["driver", "advice", "actions", "reward", *titles, *counts]
        table = pd.DataFrame(rows, columns=columns)
        table = table.rename(columns=titles)
        parts.append(table.to_html(index=False, float_format="{:.4g}".format, na_rep="-"))
    picture = run.folder / "learning_curve.png"
    if picture.is_file():
        content = base64.b64encode(read_file(picture, LARGEST_TABLE)).decode()
        parts.append(f'<img width="640" src="data:image/png;base64,{content}">')
    return "\n".join(parts)


def _means(run: Run) -> list[record.Row]:
    """Return the means of a finished run; none of another one."""
    rows = record.EVALUATION.read(run.folder) or []
    return [row for row in rows if row["case"] == MEAN_CASE]
