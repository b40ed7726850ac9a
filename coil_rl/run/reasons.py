"""Sentences on a run: its returns, the guide it holds, what is handed over, what to type next."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from coil_rl.files import SWEEP
from coil_rl.learners.anchor import StartTest
from coil_rl.record import DELIVERY, UNTESTED
from coil_rl.report.runs import EVALUATION, RETURN, SELECTION
from coil_rl.report.sentences import Sentences
from coil_rl.report.table import return_format
from coil_rl.run.stopping import command_of, resume_command

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
