"""Interval plot: what each driver scores and how sure that is, one line a driver."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coil_rl.files import whole_file
from coil_rl.report import style

ROW = 0.27  # inches, a driver
AXIS = 0.62  # inches below and above the rows, heading included
GAP = 0.06  # inches below the legend

COLOUR = style.AGENTS[0]
BAR: dict[str, Any] = {"color": COLOUR, "alpha": 0.38, "lw": 8, "solid_capstyle": "butt"}
POINT: dict[str, Any] = {"ls": "", "marker": "o", "ms": 3.6, "mfc": style.QUIET, "mec": "none", "alpha": 0.5}
DOT: dict[str, Any] = {"ls": "", "marker": "o", "ms": 5.5, "mfc": COLOUR, "mec": style.PAPER, "mew": 0.6}
HOLLOW: dict[str, Any] = {"ls": "", "marker": "o", "ms": 5.0, "mfc": style.PAPER, "mec": COLOUR, "mew": 1.1}
GUIDE: dict[str, Any] = {"color": style.GUIDES[0], "ls": (0, style.DASHES), "lw": 1.3, "zorder": 1.5}


@dataclass(frozen=True)
class Interval:
    """One line of the plot.

    Attributes:
        label: in front of it.
        value: the dot.
        low: where the bar begins; NaN for no bar.
        high: where it ends.
        points: the single seeds.
        guide: value of the guide beside which this driver drove.
        hollow: draw the dot hollow: a variant of the driver above it.
    """

    label: str
    value: float
    low: float = math.nan
    high: float = math.nan
    points: Sequence[float] = ()
    guide: float | None = None
    hollow: bool = False


def draw_intervals(
    panels: Mapping[str, Sequence[Interval]],
    path: str | os.PathLike[str],
    *,
    measure: str = "reward (interquartile mean)",
    title: str | None = None,
) -> None:
    """Draw one panel or several beside each other, with the same drivers in each.

    Args:
        panels: from heading to its lines, the first on top.
        path: the picture, in the format of its ending, 8 inches wide.
        measure: below each panel.
        title: above the picture.

    Raises:
        ValueError: if there is nothing to draw.
    """
    labels = list(dict.fromkeys(line.label for lines in panels.values() for line in lines))
    if not labels:
        raise ValueError("An interval plot needs at least one driver; got none.")
    with mpl.rc_context(style.LETTERS):
        figure = Figure(figsize=(style.WIDTH, 1), dpi=style.RESOLUTION)
        FigureCanvasAgg(figure)
        header = style.draw_header(figure, _handles(panels), title) + GAP
        height = header + AXIS + ROW * len(labels)
        figure.set_figheight(height)
        figure.set_layout_engine("constrained", rect=(0, 0, 1, 1 - header / height), w_pad=style.MARGIN / 2, h_pad=0.08)
        beside = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (heading, lines) in zip(beside, panels.items(), strict=True):
            axes.set_xlabel(measure)
            if len(panels) > 1:
                axes.set_title(heading, size=9, loc="left")
            _draw_panel(axes, {labels.index(line.label): line for line in lines})
        beside[0].set_yticks(range(len(labels)), labels)
        beside[0].set_ylim(len(labels) - 0.5, -0.5)
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")


def _draw_panel(axes: Axes, lines: Mapping[int, Interval]) -> None:
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color=style.ASPHALT, lw=0.7)
    axes.set_axisbelow(True)
    axes.margins(x=0.06)
    for y, line in lines.items():
        axes.plot([line.low, line.high], [y, y], **BAR)
        axes.plot(line.points, [y] * len(line.points), **POINT)
        axes.plot(line.value, y, **(HOLLOW if line.hollow else DOT))
    # Neighbours with the same guide share a line, or the dashes would not join.
    for value, neighbours in itertools.groupby(sorted(lines), key=lambda y: lines[y].guide):
        rows = list(neighbours)
        if value is not None:
            axes.plot([value, value], [rows[0] - 0.5, rows[-1] + 0.5], **GUIDE)


def _handles(panels: Mapping[str, Sequence[Interval]]) -> list[Artist]:
    lines = [line for of_panel in panels.values() for line in of_panel]
    shown = {
        "all seeds": (DOT, True),
        "all seeds, advice altered": (HOLLOW, any(line.hollow for line in lines)),
        "95 % interval": (BAR, any(math.isfinite(line.low) for line in lines)),
        "one seed": (POINT, any(line.points for line in lines)),
        "its guide": (GUIDE, any(line.guide is not None for line in lines)),
    }
    return [Line2D([], [], label=label, **stroke) for label, (stroke, there) in shown.items() if there]
