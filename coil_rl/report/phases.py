"""What happened in the phases of a run in which guides learn too: returns, distances and learning rates."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from coil_rl.files import whole_file
from coil_rl.report import style
from coil_rl.report.curve import unit_of_frames

Array = NDArray[np.float64]

HEIGHT = 6.8  # inches
RATIOS = (2.4, 1, 1)
AGENT = "#1a1a1a"


def draw_phases(
    rows: Sequence[Mapping[str, float]],
    guides: Sequence[str],
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
) -> None:
    """Draw one run: the agent's return with each guide's own, how far each guide moved, and who learned how fast.

    Where a guide learns, the ground has its colour.

    Args:
        rows: of `metrics.csv` of `DynamicCoil`.
        guides: their names, in their order.
        path: the picture, in the format of its ending, 8 inches wide.
        title: above the picture.

    Raises:
        ValueError: without a row.
    """
    if not rows:
        raise ValueError("A picture of phases needs at least one row; got none.")
    colours = dict(zip(guides, (style.AGENTS[place % len(style.AGENTS)] for place in range(len(guides))), strict=True))
    frames = _column(rows, "frames")
    size, unit = unit_of_frames(float(frames[-1]))
    frames = frames / size
    with mpl.rc_context(style.LETTERS):
        figure = Figure(figsize=(style.WIDTH, HEIGHT), dpi=style.RESOLUTION)
        FigureCanvasAgg(figure)
        header = style.draw_header(figure, _handles(colours), title)
        figure.set_layout_engine("constrained", rect=(0, 0, 1, 1 - header / HEIGHT), w_pad=style.MARGIN / 2, h_pad=0.08)
        top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=RATIOS)
        top.plot(frames, _column(rows, "train/return"), color=AGENT, lw=1.6)
        for name, colour in colours.items():
            own = _column(rows, f"guide/{name}")
            known = np.isfinite(own)
            # The first was measured before the first update.
            at = np.where(np.arange(len(frames)) == 0, 0.0, frames)
            top.plot(at[known], own[known], color=colour, ls=(0, style.DASHES), lw=1.1, marker="o", ms=4)
            middle.plot(frames, _column(rows, f"learner/moved_{name}"), color=colour, lw=1.4)
        _draw_rates(bottom, frames, rows, colours)
        for axes, label in {top: "return", middle: "moved (action)", bottom: "learning rate"}.items():
            axes.set_ylabel(label)
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(axis="y", color=style.ASPHALT, lw=0.7)
            axes.set_axisbelow(True)
            axes.margins(x=0)
            axes.set_xlim(left=0)
            _shade(axes, frames, rows, list(colours.values()))
        middle.set_ylim(bottom=0)
        bottom.set_xlabel(unit)
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")


def _draw_rates(axes: Axes, frames: Array, rows: Sequence[Mapping[str, float]], colours: Mapping[str, str]) -> None:
    learns = _column(rows, "learner/guide")
    rates = {AGENT: _column(rows, "learner/learning_rate")}
    rate = _column(rows, "learner/guide_learning_rate")
    for place, colour in enumerate(colours.values()):
        rates[colour] = np.where((learns == place) | (learns == len(colours)), rate, np.nan)
    edges = np.concatenate([[0.0], frames])
    for colour, values in rates.items():
        axes.stairs(np.where(values > 0, values, np.nan), edges, color=colour, lw=1.6, baseline=None)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")


def _shade(axes: Axes, frames: Array, rows: Sequence[Mapping[str, float]], colours: Sequence[str]) -> None:
    start = 0.0
    for frame, row in zip(frames, rows, strict=True):
        place = int(row["learner/guide"])
        if 0 <= place < len(colours):
            axes.axvspan(start, float(frame), color=colours[place], alpha=0.12, lw=0)
        start = float(frame)


def _handles(colours: Mapping[str, str]) -> list[Artist]:
    handles: list[Artist] = [Line2D([], [], color=AGENT, lw=1.6, label="agent, in training")]
    for name, colour in colours.items():
        handles.append(
            Line2D([], [], color=colour, ls=(0, style.DASHES), lw=1.1, marker="o", ms=4, label=f"{name} alone")
        )
    handles.append(Patch(color=style.QUIET, alpha=0.25, lw=0, label="a guide learns (its colour)"))
    return handles


def _column(rows: Sequence[Mapping[str, float]], key: str) -> Array:
    return np.array([row.get(key, np.nan) for row in rows], dtype=np.float64)
