"""Markdown pages of reproduced results: verdicts on the paper's claims, pages, and RESULTS.md with all pages."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from coil_rl.report import markdown_table
from coil_rl.report.runs import Run
from coil_rl.report.statistics import SIGN_FLIP_SEEDS, Estimate, holm
from coil_rl.reproduce.result import PAGES

CLAIMS_HEADING = "### What held up"
SIGNIFICANT = 0.05
FOOTER = "<sub>"  # begins the origin of a page


class Claim(NamedTuple):
    """The claim that a number is positive, or negative for sign -1; `spec` is its format."""

    estimate: Estimate
    spec: str
    sign: int = 1

    def verdict(self, p: float) -> str | None:
        """Return the verdict as a table cell, given the corrected p-value; None if the number is NaN."""
        number = self.estimate.cell(self.spec)
        if number is None:
            return None
        decided = p < SIGNIFICANT
        word = (
            "undecided"
            if not decided
            else "held up"
            if self.sign * self.estimate.mean > 0
            else "did not hold up"
        )
        seeds = "1 seed" if self.estimate.seeds == 1 else f"{self.estimate.seeds} seeds"
        return f"**{word}**: {number}, {seeds}" + ("" if math.isnan(p) else f", p {p:.3f}")


def certain_verdict(holds: bool, details: str) -> str:
    """Return the verdict on a claim without an interval, as a table cell."""
    return f"**{'held up' if holds else 'did not hold up'}**: {details}"


def claims_section(claims: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> str:
    """Return the last section of a page, a table of claims: `claim`, `world`, and cells of the columns by key.

    Cells that are a `Claim` become verdicts; those of a world are a family of tests. The main world
    is "", or missing.
    """
    headings = {key: (heading, "") for key, heading in {"claim": "claim", **columns}.items()}
    found = [
        (row.get("world"), cell.estimate.p)
        for row in claims
        for cell in row.values()
        if isinstance(cell, Claim)
    ]
    corrected = {world: iter(holm([p for of, p in found if of == world])) for world in dict(found)}
    rows = [
        {
            key: cell.verdict(float(next(p))) if isinstance(cell, Claim) else cell
            for key, cell in row.items()
        }
        | {"claim": ", ".join(filter(None, [row["claim"], row.get("world")]))}
        for row in claims
        for p in [corrected.get(row.get("world"), iter(()))]
    ]
    return f"{CLAIMS_HEADING}\n\n{markdown_table(rows, headings)}"


def world_heading(world: str) -> list[str]:
    """Return the heading of a world's part of a page as a list; empty for the main world, which has no name."""
    return [f"### {world[:1].upper()}{world[1:]}"] if world else []


def page(text: str, name: str, note: str | None, origin: str) -> str:
    """Return the page of a result: heading, warning, picture, text, origin.

    `text` begins with the heading; `name` is the stem of the result's files.
    """
    heading, _, rest = text.partition("\n")
    picture = f"![{heading.lstrip('# ')}]({name}.png)"
    return (
        "\n\n".join([heading, *_warning(note), picture, rest.strip(), f"{FOOTER}{origin}</sub>"])
        + "\n"
    )


def origin(command: str, commit: str, runs: Sequence[Run] = ()) -> str:
    """Return one line on the origin of a result: its command, the code's commit by `git describe`, training runs."""
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
    about_runs = f"{len(runs)} runs with the seeds {', '.join(map(str, seeds))}, made at commit {', '.join(commits)}"
    return f"{made} {about_runs}. Training frames: {frames or 'none'}."


def all_results(
    pages: Mapping[str, str | None],
    commands: Mapping[str, str],
    command: str,
    note: str | None,
    known_problems: Iterable[str],
    not_reproduced: Iterable[str],
) -> str:
    """Return RESULTS.md, given the page (None if missing) and the command of each result, and the command of all."""
    split = [_split_claims(text) for text in pages.values() if text is not None]
    parts = ["# Results", *_warning(note), PAGES["results"]["introduction"].format(command=command)]
    if claims := [
        f"**{text.splitlines()[0].lstrip('# ')}**\n\n{table}" for text, table in split if table
    ]:
        verdicts = PAGES["results"]["verdicts"].format(seeds=SIGN_FLIP_SEEDS)
        parts += ["## What held up, and what did not", verdicts, *claims]
    parts += [text.replace(f"> **{note}**\n\n", "").strip() for text, _ in split]
    if missing := [f"- `{commands[name]}`" for name, text in pages.items() if text is None]:
        parts += ["## Not made yet", "\n".join(missing)]
    lists = {
        "What is known about the paper's numbers": known_problems,
        "What cannot be shown here": not_reproduced,
    }
    for heading, sentences in lists.items():
        parts += [
            f"## {heading}",
            "\n".join(f"- {' '.join(sentence.split())}" for sentence in sentences),
        ]
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
