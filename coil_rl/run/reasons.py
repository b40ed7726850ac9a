"""Sentences on a run: what its returns are, which guide it holds, and what is handed over."""

import math
from collections.abc import Mapping
from pathlib import Path

from coil_rl.learners.anchor import StartTest
from coil_rl.record import DELIVERY, UNTESTED
from coil_rl.report.runs import EVALUATION, SELECTION
from coil_rl.report.sentences import Sentences
from coil_rl.report.table import return_format

SENTENCES = Sentences("coil_rl.run", "evaluation.j2")
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
