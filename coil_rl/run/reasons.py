"""Sentences on the tests of a run: which guide its policy holds, and what is handed over."""

import math
from collections.abc import Mapping
from pathlib import Path

from coil_rl.learners.anchor import StartTest
from coil_rl.record import DELIVERY, UNTESTED
from coil_rl.report.table import return_format

FIRST = "first"  # policy of a run that holds its guide
POLICIES = {
    "last": "the last policy",
    UNTESTED: "the last policy",
    "earlier": "an earlier policy",
    FIRST: "the first policy",
    "tuned": "the tuned guide",
    "best_candidate": "the best candidate",
}


def start_test(row: Mapping[str, float]) -> str | None:
    """Return the sentences that say which guide an anchored policy holds; None without a test.

    Args:
        row: of `metrics.csv`, that of the state before the first update.
    """
    guide, opposite, new, cases, weight = (row.get(name, math.nan) for name in StartTest.names)
    if math.isnan(cases):
        return None
    returns = {"the guide": guide, "its opposite": opposite, "the new policy": new}
    known = {name: value for name, value in returns.items() if not math.isnan(value)}
    spec = return_format(known.values())
    listed = ", ".join(f"{name} {value:{spec}}" for name, value in known.items())
    if weight:
        title = "guide" if weight > 0 else "opposite of the guide"
        gain = ""
        if abs(weight) != 1:
            gain = f" at {abs(weight):g} of its distance from the middle of the action's range"
        outcome = f"The {title} is held{gain}, and the policy starts there."
    elif max(known.values()) > new:
        outcome = (
            "None is held, as no difference is large and certain enough in these cases, so the "
            "policy learns without the advice; with more frames the test has more cases."
        )
    else:
        outcome = "None is better than the new policy, so it learns without the advice."
    return f"Start test, mean returns in {cases:.0f} new cases: {listed}. {outcome}"


def beyond_budget(folder: Path, frames: int) -> str | None:
    """Return the sentence for a search that took more frames than its budget; None for another.

    Args:
        folder: of the run.
        frames: the budget.

    Raises:
        UserError: if the file is damaged.
    """
    report = DELIVERY.read(folder)
    if report is None or report.steps <= frames:
        return None
    return (
        f"The search took {report.steps:,} frames, more than budget.frames={frames:,}: that is "
        "too little for a generation and a test of its result."
    )


def handed_over(folder: Path) -> str | None:
    """Return the sentence that says what a run handed over and why; None without a test.

    Args:
        folder: of the run.

    Raises:
        UserError: if the file is damaged.
    """
    report = DELIVERY.read(folder)
    if report is None:
        return None
    chosen, returns, ahead = report.policy, report.returns, report.ahead
    if chosen == UNTESTED:
        return (
            "Handed over is the last policy, without a test at the end: the frames that are left "
            "for it are too few for two cases, and no guide is held."
        )
    names = dict(POLICIES)
    if report.frames is not None:
        names["earlier"] = f"the policy after {report.frames:,} frames"
    spec = return_format(returns.values())
    listed = ", ".join(f"{names.get(name, name)} {value:{spec}}" for name, value in returns.items())
    title = names.get(chosen, f"the {chosen} itself, and nothing that was learned")
    if chosen == FIRST:
        title += ", which is its guide and has learned nothing"
    sentence = (
        f"Handed over is {title}: mean returns in {report.cases} new cases of the training, "
        f"whose steps are among its frames: {listed}"
    )
    if ahead:
        mean, low, high = (f"{value:+{spec}}" for value in ahead)
        sentence += f"; it is {mean} ahead of the last policy ({low} to {high}, 95 % interval)"
    if chosen not in names and "last" in returns:
        return f"{sentence}. With policy=last the last policy is evaluated."
    return f"{sentence}."
