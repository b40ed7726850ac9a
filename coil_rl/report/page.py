"""From a comparison to Markdown: a table of drivers, one of tracks, and how to read them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from coil_rl.report.comparison import Comparison
from coil_rl.report.curve import TRAINING, points
from coil_rl.report.runs import GUIDE, Run
from coil_rl.report.table import markdown_table

IN_ONE_TABLE = 8  # tracks
OWN_RETURN = "guide/"  # as the columns of metrics.csv begin

COLUMNS = {
    "driver": ("driver", ""),
    "advice": ("advice", ""),
    "seeds": ("seeds", ""),
    "iqm": ("reward (IQM)", ".1f"),
    "interval": ("95 % interval", ""),
    "mean": ("mean", ".1f"),
    "completed": ("completed", ".0%"),
    "crashed": ("crashed", ".0%"),
    "lap_time": ("lap (s)", ".2f"),
    "smoothness": ("smoothness", ".3f"),
    "clearance": ("smallest clearance (m)", ".2f"),
    "improvement": ("better than {other}", ".0%"),
    "needs_guide": ("guide at test time", ""),
}


def section(heading: str, found: Comparison, rows: Sequence[Mapping[str, Any]], against: str | None) -> str:
    """What was compared under one kind of actions.

    Args:
        heading: above it.
        found: the comparison.
        rows: its `table`.
        against: over which improvement is reported, if over any.
    """
    columns = {key: (text.format(other=whose(against)), spec) for key, (text, spec) in COLUMNS.items()}
    if not any(row["advice"] for row in rows):
        del columns["advice"]
    if against is None:
        del columns["improvement"]
    table = markdown_table([{**row, "interval": _interval(row["low"], row["high"])} for row in rows], columns)
    return "\n\n".join([f"## {heading}", table, *_tasks(found), _tracks(found)])


def guides_that_learned(runs: Sequence[Run]) -> list[str]:
    """What the guides earned alone on the training tracks, before their run and after it, if any of them learned."""
    rows: list[dict[str, Any]] = []
    for label in dict.fromkeys(run.label for run in runs):
        curves = [run.curve for run in runs if run.label == label and run.curve]
        names = dict.fromkeys(key for curve in curves for key in curve[0] if key.startswith(OWN_RETURN))
        own = {name: [[row[name] for row in curve if not math.isnan(row[name])] for curve in curves] for name in names}
        ends = {
            name: (mean(seed[0] for seed in seeds), mean(seed[-1] for seed in seeds)) for name, seeds in own.items()
        }
        cells = {name: f"{before:.1f} to {after:.1f}" for name, (before, after) in ends.items()}
        rows += [{"label": label, "seeds": len(curves)} | cells] if cells else []
    if not rows:
        return []
    columns = {"label": ("guides' own return, before to after", ""), "seeds": ("seeds", "")}
    names = dict.fromkeys(key for row in rows for key in row if key.startswith(OWN_RETURN))
    columns |= {name: (name.removeprefix(OWN_RETURN), "") for name in names}
    return [markdown_table(rows, columns)]


def learning(runs: Sequence[Run]) -> list[str]:
    """Means over the seeds of what their learning curves say, and of how long they took, if anything was learned."""
    rows: list[dict[str, Any]] = []
    for label in dict.fromkeys(run.label for run in runs):
        learned = [run for run in runs if run.label == label and run.curve]
        curves = [points(run.curve, TRAINING)[:, 1].tolist() for run in learned]
        known = [curve for curve in curves if curve]
        took = [run.seconds for run in learned if run.seconds is not None]
        if known:
            rows.append({
                "label": label, "seeds": len(known), "highest": mean(map(max, known)), "area": mean(map(mean, known)),
                "final": mean(curve[-1] for curve in known), "frames": max(run.curve[-1]["frames"] for run in learned),
                "seconds": mean(took) if took else None,
            })  # fmt: skip
    columns = {
        "label": ("return in training", ""), "seeds": ("seeds", ""), "frames": ("frames", ",.0f"),
        "area": ("area under the curve / frames", ".1f"), "final": ("final", ".1f"), "highest": ("highest", ".1f"),
        "seconds": ("training (s)", ".0f"),
    }  # fmt: skip
    rows.sort(key=lambda row: -float(row["area"]))
    return [markdown_table(rows, columns)] if rows else []


def notes(resamples: int, against: str | None) -> str:
    """How to read the tables."""
    text = (
        "IQM: the mean of the middle half of the rewards of all seeds on all tracks. Its interval: percentile "
        f"bootstrap, {resamples} resamples of whole seeds; with few seeds it is too narrow (with five it holds the "
        "mean in about 85 of 100 cases)."
    )
    if against is not None:
        text += f" Better than {whose(against)}: the probability of more reward on a track, any run against any run."
    return text


def progress(finished: int, begun: int) -> str:
    """How many runs the tables are about, and how to get the rest; of a run that is yet to begin there is no trace."""
    if finished == begun:
        return f"All {begun} runs that have begun are finished."
    return (
        f"{finished} of {begun} runs that have begun are finished; the command that began them goes on with the rest."
    )


def whose(against: str | None) -> str:
    """What improvement is over, in words."""
    return "its guide" if against == GUIDE else str(against)


def _interval(low: float, high: float) -> str | None:
    return None if math.isnan(low) else f"{low:.1f} to {high:.1f}"


def _tasks(found: Comparison) -> list[str]:
    """The table of tasks and drivers, if there are tasks."""
    groups = (*found.guides, *found.agents)
    names = list(dict.fromkeys(task for group in groups for task in group.tasks))
    rows = [{"driver": group.title} | group.per_step for group in groups if group.tasks]
    columns = {"driver": ("reward of a step", "")} | {name: (name, ".3f") for name in names}
    return [markdown_table(rows, columns)] if names else []


def _tracks(found: Comparison) -> str:
    groups = (*found.guides, *found.agents)
    names = list(dict.fromkeys(track for group in groups for track in group.tracks))
    if len(names) > IN_ONE_TABLE:
        return f"The rewards on each of the {len(names)} tracks are in report_tracks.csv."
    rows = [
        {"driver": group.title} | {track: group.means(place)["reward"] for place, track in enumerate(group.tracks)}
        for group in groups
    ]
    columns = {"driver": ("mean reward", "")} | {name: (name, ".1f") for name in names}
    return markdown_table(rows, columns)
