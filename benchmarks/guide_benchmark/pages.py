"""Pages of the guide benchmark: one a task, and one that holds all."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.guide_benchmark.picture import ARMS, LIMIT, draw
from benchmarks.guide_benchmark.rows import references
from benchmarks.promise import ALONE, INTACT, PPO, arms_of, counted_verdicts
from coil_rl.files import write_text
from coil_rl.report import draw_learning_curves, guide_return, markdown_table
from coil_rl.report.page import some_of
from coil_rl.report.runs import GUIDE, Run

Row = dict[str, Any]
LADDER = {
    "method": ("method", ""),
    "arm": ("arm", ""),
    "effort": ("effort", ""),
    "seeds": ("seeds", "d"),
    "end": ("end", ".1f"),
    "score": ("score", ".2f"),
    "guide": ("its guide", ".1f"),
    "difference": ("end - better of guide and PPO (%)", "+.1f"),
    "low": ("low", "+.1f"),
    "high": ("high", "+.1f"),
    "verdict": ("verdict", ""),
    "first": ("first - guide (%)", "+.1f"),
    "lowest": ("lowest - guide (%)", "+.1f"),
    "frames_to_guide": ("frames to the guide", ".0f"),
    "failures": ("failures", ".0%"),
    "frames": ("frames", ".0f"),
    "seconds": ("seconds", ".0f"),
    "guide_calls": ("guide calls", ".0f"),
}
ALL = {
    "arm": ("arm", ""),
    "method": ("method", ""),
    "tasks": ("tasks", "d"),
    "score": ("score", ".2f"),
    "difference": ("end - better of guide and PPO (%)", "+.1f"),
    "gain": ("gains", "d"),
    "even": ("even", "d"),
    "unknown": ("unknown", "d"),
    "loss": ("losses", "d"),
    "worst": ("worst task (%)", "+.1f"),
    "lowest": ("lowest - guide, worst task (%)", "+.1f"),
}
METHODS = {
    "method": ("method", ""),
    "tasks": ("tasks", "d"),
    "pairs": ("pairs of task and guide", "d"),
    "gain": ("gains", "d"),
    "even": ("even", "d"),
    "unknown": ("unknown", "d"),
    "loss": ("losses", "d"),
    "difference": ("end - better of guide and PPO (%)", "+.1f"),
    "worst": ("worst pair (%)", "+.1f"),
    "where": ("which it is", ""),
}
EDGE = (
    f"Large: the mean over tasks; small: each task. What lies beyond {LIMIT:.0f} % is at the edge."
)
SMOKE = "**Smoke: too few seeds or frames for a conclusion**; it only shows that everything runs."


def draw_curves(folder: Path, task: str, runs: Sequence[Run]) -> None:
    """Draw the learning curves with the intact guide and of PPO; a picture that exists stays."""
    if (folder / f"{task}.webp").exists():
        return
    arms = arms_of(runs)
    curves = {
        method: [run.curve for run in arm.runs.values() if run.curve]
        for (method, name), arm in arms.items()
        if name == INTACT or (method, name) == (PPO, ALONE)
    }
    intact = [run for (_, arm), each in arms.items() if arm == INTACT for run in each.runs.values()]
    draw_learning_curves(
        {method: seeds for method, seeds in curves.items() if seeds},
        folder / f"{task}.webp",
        guides={GUIDE: guide_return(intact)},
        title=f"{task}: with its intact guide",
    )


def write_task(folder: Path, task: str, rows: Sequence[Row]) -> None:
    """Write the page of a task with its curves, if they are drawn, and its ladder.

    Args:
        rows: of the table, the best first.
    """
    reference = references()[task]
    picture = f"{task}.webp"
    lines = [
        f"# {task}",
        *([SMOKE] if all(row["effort"] == "smoke" for row in rows) else []),
        f"Score 0 is the random guide ({rows[0]['random']:.1f}), score 1 is "
        f"{rows[0]['reference']:.1f}: {reference.source}. Percentages are of the distance from the "
        "random guide to the better of PPO and the intact guide.",
        *([f"![learning curves]({picture})"] if (folder / picture).exists() else []),
        "## Ladder",
        markdown_table([{**row, "frames_to_guide": _frames_to_guide(row)} for row in rows], LADDER),
        *_several_ppo(rows),
        f"Runs in the table: {sum(row['seeds'] for row in rows)}.",
    ]
    write_text(folder / f"{task}.md", "\n\n".join(lines) + "\n")


def _several_ppo(rows: Sequence[Row]) -> list[str]:
    """Return a sentence with the returns of PPO that rows are compared with, if there are several.

    Rows of another sweep, or of fewer seeds, are compared with the PPO of these.
    """
    known = [row for row in rows if row["arm"] != ALONE and not math.isnan(row["ppo"])]
    returns = Counter(f"{row['ppo']:.1f}" for row in known)
    if len(returns) < 2:
        return []
    (most, _), *others = returns.most_common()
    parts = []
    for ppo, _ in others:
        own = [row for row in known if f"{row['ppo']:.1f}" == ppo]
        rest = {row["method"] for row in known if row not in own}
        names = {f"{r['method']} {r['arm']}" if r["method"] in rest else r["method"] for r in own}
        parts.append(f"rows of {', '.join(sorted(names))} with {ppo}")
    return [
        "Each row is compared with PPO of its own sweep and seeds: "
        f"{'; '.join(parts)}; the others with {most}."
    ]


def _frames_to_guide(row: Row) -> float | str:
    """Return the mean frames to the guide, with the number of seeds if some did not reach it.

    Without the mean, and in older rows without the number, it is the mean alone.
    """
    frames = float(row["frames_to_guide"])
    if math.isnan(frames) or row["reached"] is None:
        return frames
    return f"{frames:.0f}{some_of(row['reached'], row['seeds'])}"


def write_all(folder: Path, rows: Sequence[Row]) -> str:
    """Write the page that holds all tasks, with its picture, and return its text."""
    lines = ["# All tasks of the guide benchmark"]
    if all(row["effort"] == "smoke" for row in rows):
        lines.append(SMOKE)
    summary = summarised(rows)
    if summary:
        draw(rows, folder / "all.png")
        lines += ["![all tasks](all.png)", EDGE]
        lines += ["## By method, the fewest losses first", _table(by_method(rows), METHODS)]
        lines += ["## By guide and method", _table(summary, ALL)]
    counted = counted_verdicts(row["verdict"] for row in rows if row["arm"] != ALONE)
    lines.append(
        f"{counted}. "
        "Means are over tasks; score 0 is the random guide, score 1 the reference of the task."
    )
    tasks = sorted({row["task"] for row in rows})
    pages = [f"[{task}]({task}.md)" if (folder / f"{task}.md").exists() else task for task in tasks]
    lines.append("Tasks: " + ", ".join(pages) + ".")
    text = "\n\n".join(lines) + "\n"
    write_text(folder / "README.md", text)
    return text


def _table(rows: Sequence[Row], columns: Mapping[str, Sequence[str]]) -> str:
    """Return a table, with the column of unknown verdicts only if there are any."""
    shown = dict(columns)
    if not any(row["unknown"] for row in rows):
        del shown["unknown"]
    return markdown_table(rows, shown)


def summarised(rows: Sequence[Row]) -> list[Row]:
    """Return a row for each arm and method over all tasks, in the order of the arms."""
    found = _summaries(rows, "arm", "method")
    return sorted(found, key=lambda row: (ARMS.index(row["arm"]), row["method"]))


def by_method(rows: Sequence[Row]) -> list[Row]:
    """Return a row for each method over all tasks and guides, with the fewest losses first."""
    found = _summaries(rows, "method")
    return sorted(found, key=lambda row: (row["loss"] / row["pairs"], -row["difference"]))


def _summaries(rows: Sequence[Row], *names: str) -> list[Row]:
    """Return a row for all rows with a guide that have the same values of some columns."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        if row["arm"] in ARMS:
            groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return [dict(zip(names, key, strict=True)) | _summary(own) for key, own in groups.items()]


def _summary(rows: Sequence[Row]) -> Row:
    counts = Counter(row["verdict"] for row in rows)
    lowest = [row["lowest"] for row in rows if not math.isnan(row["lowest"])]
    worst = rows[int(np.argmin([row["difference"] for row in rows]))]
    return {
        "pairs": len(rows),
        "where": f"{worst['task']}, {worst['arm']}",
        "tasks": len({row["task"] for row in rows}),
        "score": float(np.mean([row["score"] for row in rows])),
        "difference": float(np.mean([row["difference"] for row in rows])),
        **{name: counts[name] for name in ("gain", "even", "unknown", "loss")},
        "worst": worst["difference"],
        "lowest": min(lowest, default=math.nan),
    }
