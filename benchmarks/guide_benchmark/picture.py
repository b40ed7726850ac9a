"""The picture of the guide benchmark: what each method gave with each guide, in all tasks."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from benchmarks.promise import ALONE
from coil_rl.report import style

ARMS = ("intact", "detuned", "half", "late", "reversed", "shuffled", "random")
PANELS = {
    "difference": "end - better of guide and PPO (% of the scale)",
    "lowest": "lowest kept policy - guide (% of the scale)",
}
NARROW = 0.7  # share of an arm's place that its methods take
LIMIT = 110.0  # % of the scale; what lies beyond is drawn at the edge
Rows = Sequence[Mapping[str, Any]]


def draw(rows: Rows, path: Path) -> None:
    """Draw a line for each arm and method: small a dot for each task, large their mean."""
    compared = [row for row in rows if row["arm"] != ALONE]
    arms = [arm for arm in ARMS if any(row["arm"] == arm for row in compared)]
    methods = list(dict.fromkeys(str(row["method"]) for row in compared))
    strokes = style.strong_strokes(methods)
    handles = [
        Line2D([], [], color=stroke.colour, marker=_marker(stroke), lw=0, label=method)
        for method, stroke in strokes.items()
    ]
    height = 0.8 + len(arms) * max(0.5, 0.14 * len(methods))
    title = "Guide benchmark: is a method at least as good as the better of guide and PPO?"
    with style.picture(path, title, handles, height, add_header=True) as figure:
        panels = figure.subplots(1, len(PANELS), sharey=True)
        for axes, (column, text) in zip(panels, PANELS.items(), strict=True):
            _draw_panel(axes, column, compared, arms, strokes)
            axes.set_xlabel(text)


def _draw_panel(
    axes: Axes,
    column: str,
    rows: Rows,
    arms: Sequence[str],
    strokes: Mapping[str, style.Stroke],
) -> None:
    """Draw one column of the table."""
    for place, arm in enumerate(arms):
        for number, (method, stroke) in enumerate(strokes.items()):
            own = [row for row in rows if (row["arm"], row["method"]) == (arm, method)]
            values = np.array([row[column] for row in own if math.isfinite(row[column])])
            if not len(values):
                continue
            y = place + NARROW * ((number + 0.5) / len(strokes) - 0.5)
            marker = _marker(stroke)
            shown = values.clip(-LIMIT, LIMIT)
            axes.scatter(shown, np.full(len(shown), y), s=9, color=stroke.colour, alpha=0.5, lw=0)
            mean = values.mean().clip(-LIMIT, LIMIT)
            axes.scatter(mean, y, s=34, color=stroke.colour, marker=marker, zorder=3)
    axes.axvline(0, color=style.INK, lw=0.9)
    axes.set_yticks(range(len(arms)), arms)
    axes.set_ylim(len(arms) - 0.5, -0.5)
    style.lighten(axes, grid="x")


def _marker(stroke: style.Stroke) -> str:
    """Return a circle, or a diamond where the colour is used a second time."""
    return "o" if stroke.linestyle == "-" else "D"
