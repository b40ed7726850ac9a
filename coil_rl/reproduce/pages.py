"""Markdown pages of reproduced results, and RESULTS.md with all of them."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from coil_rl.report.runs import Run
from coil_rl.reproduce.result import CLAIMS_HEADING

FOOTER = "<sub>"  # begins the origin of a page

INTRODUCTION = """
`{command}` writes this file; do not edit it. Below each result stand the command that makes it alone, and the commits
of the code. The paper's numbers are beside ours; its tracks and its robot are not part of this project, so compare the
order of the methods and the distances between them."""

VERDICTS = """
Each claim of the paper with our number and its 95 % interval: held up if the whole interval is on the paper's side, did
not hold up if it is on the other side, undecided otherwise."""


def page(text: str, name: str, note: str | None, origin: str) -> str:
    """Return the page of a result: heading, note, picture, text, origin.

    Args:
        text: of the result, the heading first.
        name: stem of its files.
        note: a warning to the reader, if any.
        origin: see `origin`.
    """
    heading, _, rest = text.partition("\n")
    parts = [
        heading,
        *_warning(note),
        f"![{heading.lstrip('# ')}]({name}.png)",
        rest.strip(),
        f"{FOOTER}{origin}</sub>",
    ]
    return "\n\n".join(parts) + "\n"


def origin(command: str, commit: str, runs: Sequence[Run] = ()) -> str:
    """Return one line on the origin of a result.

    Args:
        command: the command that makes it.
        commit: the code's commit, by `git describe`.
        runs: its training runs.
    """
    made = f"Made by `{command}` at commit {_commit(commit)}."
    if not runs:
        return made
    seeds = sorted({run.seed for run in runs})
    labels: dict[int, dict[str, None]] = {}
    for run in runs:
        if run.curve:
            labels.setdefault(int(run.curve[-1]["frames"]), {})[run.label] = None
    frames = "; ".join(f"{count:,} ({', '.join(names)})" for count, names in labels.items())
    commits = dict.fromkeys(_commit(_run_commit(run.folder)) for run in runs)
    return (
        f"{made} {len(runs)} runs with the seeds {', '.join(map(str, seeds))}, made at commit {', '.join(commits)}. "
        f"Training frames: {frames or 'none'}."
    )


def all_results(
    pages: Mapping[str, str | None],
    commands: Mapping[str, str],
    command: str,
    note: str | None,
    known_problems: Iterable[str],
    limits: Iterable[str],
) -> str:
    """Return RESULTS.md.

    Args:
        pages: page of each result by name; None for a missing one.
        commands: command of each result by name.
        command: the command that makes all results.
        note: a warning to the reader, if any.
        known_problems: sentences on problems of the paper's numbers.
        limits: sentences on parts of the paper that are not reproduced.
    """
    split = {name: _split_claims(text) for name, text in pages.items() if text is not None}
    parts = ["# Results", *_warning(note), INTRODUCTION.strip().format(command=command)]
    if claims := [
        f"**{text.partition(chr(10))[0].lstrip('# ')}**\n\n{table}" for text, table in split.values() if table
    ]:
        parts += ["## What held up, and what did not", VERDICTS.strip(), *claims]
    parts += [text.replace(f"> **{note}**\n\n", "").strip() for text, _ in split.values()]
    if missing := [f"- `{commands[name]}`" for name, text in pages.items() if text is None]:
        parts += ["## Not made yet", "\n".join(missing)]
    lists = {"What is known about the paper's numbers": known_problems, "What cannot be shown here": limits}
    for heading, sentences in lists.items():
        parts += [f"## {heading}", "\n".join(f"- {' '.join(sentence.split())}" for sentence in sentences)]
    return "\n\n".join(parts) + "\n"


def _split_claims(text: str) -> tuple[str, str]:
    """Split a page into the page without its claims, and the claims."""
    before, _, after = text.partition(CLAIMS_HEADING)
    claims, _, origin = after.partition(FOOTER)
    return (f"{before}{FOOTER}{origin}", claims.strip()) if claims else (text, "")


def _warning(note: str | None) -> list[str]:
    return [f"> **{note}**"] if note else []


def _commit(described: str) -> str:
    clean = described.removesuffix("-dirty")
    return f"`{clean}`" if clean == described else f"`{clean}` with local changes"


def _run_commit(folder: Path) -> str:
    try:
        return str(json.loads((folder / "versions.json").read_text())["commit"])
    except (OSError, ValueError, KeyError, TypeError):
        return "unknown"
