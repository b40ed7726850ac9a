"""Markdown pages of reproduced results.

A page is made of the text of its result, the verdicts on the paper's claims, and a line on its
origin. RESULTS.md joins all pages.
"""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, StrictUndefined

from coil_paper.reproduce.result import PAGES
from coil_rl.report import SIGN_FLIP_SEEDS, Estimate, Run, holm, markdown_table, p_text

CLAIMS_HEADING = "### What held up"
SIGNIFICANT = 0.05
FOOTER = "<sub>"  # begins the origin of a page
RESULTS = Environment(
    undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
).from_string(PAGES["results"])


class Claim(NamedTuple):
    """The claim that a number is positive, or negative.

    Attributes:
        estimate: the number, its interval and its p-value.
        spec: the format of the number.
        sign: 1 if the number is claimed to be positive, -1 if negative.
    """

    estimate: Estimate
    spec: str
    sign: int = 1

    def verdict(self, p: float) -> str | None:
        """Return the verdict as a table cell; None if the number is NaN.

        Args:
            p: the corrected p-value of the number; NaN without a test, as for a single seed.
        """
        number = self.estimate.cell(self.spec)
        if number is None:
            return None
        if not p < SIGNIFICANT:
            word = "undecided"
        elif self.sign * self.estimate.mean > 0:
            word = "held up"
        else:
            word = "did not hold up"
        seeds = "1 seed" if self.estimate.seeds == 1 else f"{self.estimate.seeds} seeds"
        verdict = f"**{word}**: {number}, {seeds}"
        return verdict if math.isnan(p) else f"{verdict}, p {p_text(p)}"


def certain_verdict(holds: bool, details: str) -> str:
    """Return the verdict on a claim without an interval, as a table cell.

    Args:
        holds: whether the claim held up.
    """
    return f"**{'held up' if holds else 'did not hold up'}**: {details}"


def claims_section(claims: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> str:
    """Return the last section of a page, a table of claims.

    Args:
        claims: rows with a `claim`, the `world` of the claim ("", or missing, for the main world),
            and cells by the keys of the columns. Cells that are a `Claim` become verdicts; those of
            one world are a family of tests.
        columns: the headings of the further columns by key.
    """
    headings = {key: (heading, "") for key, heading in {"claim": "claim", **columns}.items()}
    rows = []
    corrected = _corrected_by_world(claims)
    for row in claims:
        shown = dict(row)
        for key, cell in row.items():
            if isinstance(cell, Claim):
                shown[key] = cell.verdict(float(next(corrected[row.get("world")])))
        if row.get("world"):
            shown["claim"] = f"{row['claim']}, {row['world']}"
        rows.append(shown)
    return f"{CLAIMS_HEADING}\n\n{markdown_table(rows, headings)}"


def _corrected_by_world(
    claims: Sequence[Mapping[str, Any]],
) -> dict[str | None, Iterator[float]]:
    """Return Holm's p-values of the claims of each world, in the order of their cells."""
    found: dict[str | None, list[float]] = {}
    for row in claims:
        for cell in row.values():
            if isinstance(cell, Claim):
                found.setdefault(row.get("world"), []).append(cell.estimate.p)
    return {world: iter(holm(p_values)) for world, p_values in found.items()}


def world_heading(world: str) -> list[str]:
    """Return the heading of a world's part of a page, as a list of parts of the page.

    Args:
        world: name of the world; "" for the main world, whose part has no heading.
    """
    return [f"### {world[:1].upper()}{world[1:]}"] if world else []


def page(text: str, name: str, note: str | None, origin: str) -> str:
    """Return the page of a result: heading, warning, picture, text, origin.

    Args:
        text: what the result says, beginning with the heading.
        name: the stem of the result's files.
        note: a warning below the heading; None for none.
        origin: how the result was made, see `origin`.
    """
    heading, _, rest = text.partition("\n")
    picture = f"![{heading.lstrip('# ')}]({name}.png)"
    warning = [f"> **{note}**"] if note else []
    parts = [heading, *warning, picture, rest.strip(), f"{FOOTER}{origin}</sub>"]
    return "\n\n".join(parts) + "\n"


def origin(command: str, commit: str, runs: Sequence[Run] = ()) -> str:
    """Return one line that says how a result was made.

    Args:
        commit: the commit of the code, as `git describe` names it.
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
        f"{made} {len(runs)} runs with the seeds {', '.join(map(str, seeds))}, "
        f"made at commit {', '.join(commits)}. Training frames: {frames or 'none'}."
    )


def all_results(
    pages: Mapping[str, str | None],
    commands: Mapping[str, str],
    command: str,
    note: str | None,
    known_problems: Iterable[str],
    not_reproduced: Iterable[str],
) -> str:
    """Return RESULTS.md, which joins the verdicts and the pages of all results.

    Args:
        pages: the page of each result by its name; None if it is not made yet.
        commands: the command of each result by its name.
        note: the warning in each page, which is given only once; None for none.
        known_problems: sentences on the paper's numbers.
    """
    split = [_split_claims(text) for text in pages.values() if text is not None]
    claims = {text.splitlines()[0].lstrip("# "): table for text, table in split if table}
    return RESULTS.render(
        note=note,
        command=command,
        seeds=SIGN_FLIP_SEEDS,
        claims=claims,
        texts=[text.replace(f"> **{note}**\n\n", "").strip() for text, _ in split],
        missing=[commands[name] for name, text in pages.items() if text is None],
        known_problems=known_problems,
        not_reproduced=not_reproduced,
    )


def _split_claims(text: str) -> tuple[str, str]:
    """Split a page into the page without its claims, and the claims."""
    before, _, after = text.partition(CLAIMS_HEADING)
    claims, _, origin = after.partition(FOOTER)
    if not claims:
        return text, ""
    return f"{before}{FOOTER}{origin}", claims.strip()


def _commit(described: str) -> str:
    clean = described.removesuffix("-dirty")
    return f"`{clean}`" if clean == described else f"`{clean}` with local changes"


def _run_commit(folder: Path) -> str:
    try:
        return str(json.loads((folder / "versions.json").read_text())["commit"])
    except (OSError, ValueError, KeyError, TypeError):
        return "unknown"
