"""From results to pages: where each comes from, and RESULTS.md, which has them all."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from coil_rl.report.runs import Run
from coil_rl.reproduce.verdict import END, divide


def page(text: str, name: str, note: str | None, origin: str) -> str:
    """The page of a result: its heading, what to know before reading, its picture, its text, and where it comes from.

    Args:
        text: that it made, heading first.
        name: of its files.
        note: what to know; None for nothing.
        origin: of `origin`.
    """
    heading, _, rest = text.partition("\n")
    warning = [f"> **{note}**"] if note else []
    parts = [heading, *warning, f"![{heading.lstrip('# ')}]({name}.png)", rest.strip(), f"{END}{origin}</sub>"]
    return "\n\n".join(parts) + "\n"


def origin(command: str, commit: str, runs: Sequence[Run] = ()) -> str:
    """Where a result comes from, in a line.

    Args:
        command: that makes it again.
        commit: of the code that made it, as `git describe` says it.
        runs: that it was made from.
    """
    said = f"Made by `{command}` at commit {_commit(commit)}."
    if not runs:
        return said
    seeds = sorted({run.seed for run in runs})
    trained: dict[int, list[str]] = {}
    for run in runs:
        if run.curve:
            labels = trained.setdefault(int(run.curve[-1]["frames"]), [])
            labels += [] if run.label in labels else [run.label]
    frames = "; ".join(f"{count:,} ({', '.join(labels)})" for count, labels in trained.items())
    commits = dict.fromkeys(_commit_of(run.folder) for run in runs)
    return (
        f"{said} {len(runs)} runs with the seeds {', '.join(map(str, seeds))}, done at commit "
        f"{', '.join(map(_commit, commits))}. Frames of training: {frames or 'none'}."
    )


def results(
    pages: Mapping[str, str | None],
    commands: Mapping[str, str],
    everything: str,
    note: str | None,
    known_problems: Iterable[str],
    cannot: Iterable[str],
) -> str:
    """RESULTS.md.

    Args:
        pages: of all results by name; None for one that has not been made.
        commands: that make each of them.
        everything: the command that makes them all.
        note: what to know before reading; None for nothing.
        known_problems: of the paper's numbers, a sentence or two each.
        cannot: what cannot be shown here, a sentence or two each.
    """
    made = {name: text for name, text in pages.items() if text is not None}
    parts = ["# Results", *([f"> **{note}**"] if note else [])]
    parts.append(
        f"`{everything}` writes this file; do not edit it. Below each result stand the command that makes it alone, "
        "and the commits of the code. Numbers of the paper are beside ours; its tracks and its robot are not part of "
        "this project, so what can be compared is the order of the methods and how far they are apart."
    )
    divided = {name: divide(text) for name, text in made.items()}
    if held := [f"**{_title(made[name])}**\n\n{end}" for name, (_, end) in divided.items() if end]:
        parts += ["## What held up, and what did not", _HOW, *held]
    parts += [text.replace(f"> **{note}**\n\n", "").strip() for text, _ in divided.values()]
    if lacking := [f"- `{commands[name]}`" for name, text in pages.items() if text is None]:
        parts += ["## Not made yet", "\n".join(lacking)]
    for heading, sentences in {
        "What is known about the paper's numbers": known_problems,
        "What cannot be shown here": cannot,
    }.items():
        parts += [f"## {heading}", "\n".join(f"- {' '.join(sentence.split())}" for sentence in sentences)]
    return "\n\n".join(parts) + "\n"


_HOW = (
    "What the paper says, and our number with its 95 % interval: held up where all of it is on the paper's side, did "
    "not hold up where all of it is on the other, undecided in between."
)


def _title(text: str) -> str:
    return text.partition("\n")[0].lstrip("# ")


def _commit(described: str) -> str:
    plain = described.removesuffix("-dirty")
    return f"`{plain}`" if plain == described else f"`{plain}` with local changes"


def _commit_of(folder: Path) -> str:
    """Of the code that began a run."""
    try:
        return str(json.loads((folder / "versions.json").read_text())["commit"])
    except (OSError, ValueError, KeyError, TypeError):
        return "unknown"
