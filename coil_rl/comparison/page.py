"""The page of a comparison: a picture, a table, three sentences, and the command to go on with."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.comparison.arms import ARMS, GUIDE, RANDOM, TUNE
from coil_rl.comparison.entry import Entry, difference
from coil_rl.comparison.outcome import Outcome
from coil_rl.comparison.sentences import COMPARE
from coil_rl.comparison.verdict import Verdict
from coil_rl.config.python import Named
from coil_rl.report import draw_learning_curves, markdown_table
from coil_rl.report.table import AUTO_FORMAT, return_format

ROOM = 0.1  # of the scale, below the guide in the picture
COLUMNS = {
    "policy": ("policy", ""),
    "return": ("return", AUTO_FORMAT),
    "worst": ("worst case", AUTO_FORMAT),
    "failures": ("failed", ".0%"),
    "seeds": ("seeds", "d"),
    "frames": ("frames", ",.0f"),
    "seconds": ("seconds", ".0f"),
    "calls": ("guide calls", ",.0f"),
    "note": ("", ""),
}


def page_of(
    verdict: Verdict, outcome: Outcome, delayed: Sequence[str], measured: int, command: str
) -> str:
    """Return the page.

    Args:
        measured: env steps that only measured.
        command: that trains the recommended method to the end; empty for none.
    """
    columns = dict(COLUMNS)
    if all(np.isnan(row.get("failures", np.nan)) for row in outcome.rows):
        del columns["failures"]
    parts = [
        "\n".join(f"{number}. {each}" for number, each in enumerate(verdict.sentences, 1)),
        markdown_table(outcome.rows, columns),
        *COMPARE.said("about_table", measured=measured),
        *delayed,
    ]
    if command:
        lead = "Train it to the end"
        if verdict.use != verdict.train:
            lead = "To see what a whole training of anchored COIL changes"
        parts.append(f"{lead}: {command}")
    return "\n\n".join(parts)


def delayed_sentence(entry: Entry, late: Entry, random: Entry) -> list[str]:
    """Return the sentence about a step of delay on observation and action.

    Args:
        late: the same with the delay.
    """
    found = difference(late, Entry(entry.name, entry.returns[:1]))
    own, kept = float(entry.returns[0].mean()), None
    if own > random.mean:  # else there is no distance to keep
        kept = (late.mean - random.mean) / (own - random.mean)
    values = {"own": own, "spec": return_format([late.mean, own]), "found": found, "kept": kept}
    return COMPARE.said("delayed", entry=entry, late=late.mean, **values)


def command_of(given: Named, verdict: Verdict) -> str:
    """Return the command that trains what is recommended to the end, as a shell reads it.

    For objects that no command names it is a line of Python.

    Args:
        given: env, guide and everything else that was given.
    """
    if not verdict.train:
        return ""
    arm = ARMS[verdict.train]
    words = list(given.words)
    tune = given.nodes.get("tune")
    if not [key for key in given.nodes if key != "tune"]:
        if arm.name == TUNE and tune is not None:
            words.append(f"tune={_bounds(tune)}")
        return shlex.join(["coil-train", *words, *arm.words])
    method = arm.words[0].partition("=")[2]
    others = [word for word in words if not word.startswith(("env=", "env.id=", "guide"))]
    overrides = [*others, *arm.words[1:]]
    arguments = [f"method={method!r}"]
    if arm.name == TUNE:
        arguments.append(f"tune={tune!r}")
    if overrides:
        arguments.append(f"overrides={overrides!r}")
    return f"coil_rl.train(env, guide=guide, {', '.join(arguments)})"


def _bounds(tune: Mapping[str, Any] | str) -> str:
    """Return the bounds of numbers, or `auto`, as Hydra reads them."""
    if isinstance(tune, str):
        return tune
    each = (f"{name}: [{', '.join(map(str, bounds))}]" for name, bounds in tune.items())
    return f"{{{', '.join(each)}}}"


def draw(outcome: Outcome, cases: int | None, path: Path) -> None:
    """Draw the learning curves of all arms beside the guide, if a run knows its line.

    The axis is about the guide and what is better: curves far below are cut, with their number.
    """
    known = [run.guide_returns for runs in outcome.runs.values() for run in runs]
    guides = next(filter(None, known), {})
    curves = {name: [run.curve for run in runs] for name, runs in outcome.runs.items()}
    least = lowest_shown(outcome.entries)
    draw_learning_curves(curves, path, guides=guides, cases=cases, least=least)


def lowest_shown(entries: Mapping[str, Entry]) -> float | None:
    """Return the lowest return of the picture; None for a guide that is not above random actions.

    Below the guide there is as much room as above it, and a tenth of the scale at least.
    """
    guide, random = entries[GUIDE].mean, entries[RANDOM].mean
    best = max(each.mean for each in entries.values())
    if guide <= random:
        return None
    return guide - max(best - guide, ROOM * (best - random))
