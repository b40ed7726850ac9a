"""The picture of a benchmark: env steps per second against the number of cars."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from coil_rl.files import whole_file
from coil_rl.report import style

HEIGHT = 4.2  # inches
LABELS = {"steps_per_s": "env", "steps_per_s_with_guide": "env with the guide"}


def draw_driving(rows: Sequence[Mapping[str, Any]], path: str | os.PathLike[str], one_car: float | None = None) -> None:
    """Draw both speeds, each axis logarithmic.

    Args:
        rows: with `cars`, `steps_per_s` and `steps_per_s_with_guide`.
        path: the picture, in the format of its ending, 8 inches wide.
        one_car: steps per second of one car in NumPy and SciPy with the guide, drawn as a dashed line.
    """
    colours = dict(zip(LABELS, style.AGENTS, strict=False))
    with mpl.rc_context(style.LETTERS):
        figure = Figure(figsize=(style.WIDTH, HEIGHT), dpi=style.RESOLUTION)
        FigureCanvasAgg(figure)
        handles = [Line2D([], [], color=colours[key], marker="o", ms=4.5, label=label) for key, label in LABELS.items()]
        header = style.draw_header(figure, handles, "Driving under random steering")
        figure.set_layout_engine("constrained", rect=(0, 0, 1, 1 - header / HEIGHT), w_pad=style.MARGIN / 2, h_pad=0.1)
        axes = figure.add_subplot(xlabel="cars side by side", ylabel="env steps per second", xscale="log", yscale="log")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color=style.ASPHALT, lw=0.7)
        cars = [row["cars"] for row in rows]
        for key in LABELS:
            axes.plot(cars, [row[key] for row in rows], color=colours[key], lw=2, marker="o", ms=4.5)
        axes.set_xticks(cars, [f"{count:,}" for count in cars])
        axes.yaxis.set_major_formatter("{x:,.0f}")
        axes.minorticks_off()
        if one_car is not None:
            axes.axhline(one_car, color=style.QUIET, ls=(0, style.DASHES), lw=1.3)
            axes.annotate(
                "one car in NumPy and SciPy, with the guide", (cars[0], one_car), (0, 4),
                textcoords="offset points", color=style.QUIET,
            )  # fmt: skip
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")
