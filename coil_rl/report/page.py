"""Markdown page of `coil-report`: tables of drivers, cases, parts of the reward and training, and how to read them."""

import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import mean
from typing import Any

from coil_rl.report.comparison import Comparison, Group
from coil_rl.report.curves import learning
from coil_rl.report.runs import GUIDE, PER_STEP, TERM, Run
from coil_rl.report.statistics import SIGN_FLIP_SEEDS, Estimate
from coil_rl.report.table import TABLES, markdown_table

MAX_CASES = 8  # in a table
GUIDE_RETURN = "guide/"  # prefix of columns of metrics.csv


def section(
    heading: str, comparison: Comparison, rows: Sequence[Mapping[str, Any]], against: str | None
) -> str:
    """Return the section for one kind of actions; `rows` are `comparison.table(against)`."""
    score, spec = comparison.score
    names = {"other": _other(against), "score": score}
    hidden = {"advice"} if not any(row["advice"] for row in rows) else set()
    hidden |= {"difference cell", "p", "better"} if against is None else set()
    hidden |= set() if comparison.normalised else {"reward"}
    hidden |= {key for key in ("completed", "crashes") if all(row[key] is None for row in rows)}
    measures = {name: each for group in comparison.groups for name, each in group.measures.items()}
    columns = {
        key: (text.format(**names), spec)
        for key, (text, spec) in TABLES["drivers"]["columns"].items()
        if key not in hidden
    }
    columns |= {
        name: (measure.title, measure.format)
        for name, measure in measures.items()
        if measure.title and name not in ("completed", "crashed") and not name.startswith(PER_STEP)
    }
    columns["needs_guide"] = ("guide at test time", "")
    table = markdown_table(with_cells(rows, spec), columns)
    parts = _parts(comparison, TERM, "term of the reward", ".1f")
    parts += _parts(comparison, PER_STEP, "reward of a step", ".3f")
    return "\n\n".join(
        [f"## {heading}", table, *parts, cases_table(comparison.groups, "report_cases.csv")]
    )


def with_cells(rows: Sequence[Mapping[str, Any]], spec: str) -> list[dict[str, Any]]:
    """Return rows of `Comparison.table` with `score cell` and `difference cell`, which show the intervals too."""
    return [
        {
            **row,
            "score cell": Estimate(row["score"], row["low"], row["high"]).cell(spec),
            "difference cell": Estimate(
                *(row[f"difference{end}"] for end in ("", "_low", "_high"))
            ).cell(f"+{spec}"),
        }
        for row in rows
    ]


def guide_training(runs: Sequence[Run]) -> list[str]:
    """Return the table of guides' own returns before and after training; no table if no guide was trained."""
    rows: list[dict[str, Any]] = []
    for label, of_label in _trained(runs):
        curves = [run.curve for run in of_label]
        row: dict[str, Any] = {"label": label, "seeds": len(curves)}
        for key in dict.fromkeys(
            key for curve in curves for key in curve[0] if key.startswith(GUIDE_RETURN)
        ):
            returns = [
                [line[key] for line in curve if not math.isnan(line[key])] for curve in curves
            ]
            row[key] = (
                f"{mean(seed[0] for seed in returns):.1f} to {mean(seed[-1] for seed in returns):.1f}"
            )
        rows += [row] if len(row) > 2 else []
    columns = {"label": ("guides' own return, before to after", ""), "seeds": ("seeds", "")}
    columns |= {key: (key.removeprefix(GUIDE_RETURN), "") for row in rows for key in list(row)[2:]}
    return [markdown_table(rows, columns)] if rows else []


def training(runs: Sequence[Run]) -> list[str]:
    """Return the table of evaluation curves, means over seeds; no table if nothing was trained."""
    rows: list[dict[str, Any]] = []
    for label, of_label in _trained(runs):
        numbers = [learning(run) for run in of_label]
        seconds = [run.seconds for run in of_label if run.seconds is not None]
        row: dict[str, Any] = {key: mean(seed[key] for seed in numbers) for key in numbers[0]}
        row |= {
            "label": label,
            "seeds": len(of_label),
            "seconds": mean(seconds) if seconds else None,
        }
        for key in ("until_90", "until_100"):
            reached = [seed[key] for seed in numbers if not math.isnan(seed[key])]
            some = (
                f" ({len(reached)} of {len(numbers)} seeds)" if len(reached) < len(numbers) else ""
            )
            row[f"{key} cell"] = f"{mean(reached):,.0f}{some}" if reached else None
        rows += [row] if not math.isnan(row["area"]) else []
    rows.sort(key=lambda row: -float(row["area"]))
    return [markdown_table(rows, TABLES["learning"]["columns"])] if rows else []


def notes(against: str | None, normalised: bool, sampled: bool) -> str:
    """Return an explanation of the tables."""
    used = {
        "order": True,
        "normalised": normalised,
        "against": against is not None,
        "sampled": sampled,
    }
    text = " ".join(TABLES["drivers"]["notes"][key] for key in used if used[key])
    return text.format(other=_other(against), seeds=SIGN_FLIP_SEEDS)


def progress(finished: int, started: int) -> str:
    """Return a sentence on unfinished runs."""
    if finished == started:
        return f"All {started} runs that were started are finished."
    return f"{finished} of {started} runs that were started are finished; repeat their command to finish the others."


def _trained(runs: Sequence[Run]) -> Iterator[tuple[str, list[Run]]]:
    """Yield each label with its runs that have a learning curve."""
    for label in dict.fromkeys(run.label for run in runs if run.curve):
        yield label, [run for run in runs if run.label == label and run.curve]


def _other(against: str | None) -> str:
    return "its guide" if against == GUIDE else str(against)


def _parts(comparison: Comparison, prefix: str, heading: str, spec: str) -> list[str]:
    """Return the table of the columns with a prefix, PER_STEP or TERM; no table without such columns."""
    groups = {group.title: group.parts(prefix) for group in comparison.groups}
    rows = [{"driver": title} | parts for title, parts in groups.items() if parts]
    names = dict.fromkeys(key for row in rows for key in list(row)[1:])
    columns = {"driver": (heading, "")} | {
        name: (name.removeprefix(prefix), spec) for name in names
    }
    return [markdown_table(rows, columns)] if rows else []


def cases_table(groups: Sequence[Group], file: str) -> str:
    """Return the mean reward by driver and case, with the completed share below 1; a hint at a file for many cases."""
    names = dict.fromkeys(case for group in groups for case in group.cases)
    if len(names) > MAX_CASES:
        return f"The rewards in each of the {len(names)} cases are in {file}."
    rows = []
    for group in groups:
        row: dict[str, Any] = {"driver": group.title}
        for index, case in enumerate(group.cases):
            means = group.means(index)
            reward, completed = means["reward"], means.get("completed", 1.0)
            row[case] = f"{reward:.1f} ({completed:.0%} completed)" if completed < 1 else reward
        rows.append(row)
    return markdown_table(
        rows, {"driver": ("mean reward", "")} | {name: (name, ".1f") for name in names}
    )
