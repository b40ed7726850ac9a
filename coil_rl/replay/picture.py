"""A picture of what policies would have steered, over time."""

from __future__ import annotations

import os
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coil_rl.files import whole_file
from coil_rl.replay.open_loop import RECORDED, OpenLoop
from coil_rl.report import style

HEIGHT = 5.0  # inches
LABELS = ("steering (degrees)", "omega (radians/s)")


def draw_steering(found: OpenLoop, path: str | os.PathLike[str], *, title: str | None = None) -> None:
    """Draw steering and omega of each policy over time, what was recorded dashed; grey where a boundary is not seen.

    Args:
        found: what was found in a recording.
        path: the picture, in the format of its ending, 8 inches wide.
        title: above the picture.
    """
    seconds = found.recording.seconds
    strokes = style.strong_strokes(found.policies)
    if RECORDED in found.steering:
        strokes[RECORDED] = style.Stroke(style.GUIDES[0], style.DASHES)
    handles: list[Artist] = [
        Line2D([], [], color=stroke.colour, ls=stroke.linestyle, lw=1.6, label=name) for name, stroke in strokes.items()
    ]
    unseen = ~found.sighted
    if unseen.any():
        handles.append(Patch(color=style.ASPHALT, lw=0, label="a boundary is only remembered"))
    with mpl.rc_context(style.LETTERS):
        figure = Figure(figsize=(style.WIDTH, HEIGHT), dpi=style.RESOLUTION)
        FigureCanvasAgg(figure)
        header = style.draw_header(figure, handles, title)
        figure.set_layout_engine("constrained", rect=(0, 0, 1, 1 - header / HEIGHT), w_pad=style.MARGIN / 2, h_pad=0.08)
        steering, omega = figure.subplots(2, sharex=True)
        for axes, label in zip((steering, omega), LABELS, strict=True):
            _prepare(axes, label, seconds, unseen)
        for name, stroke in strokes.items():
            look = {"color": stroke.colour, "ls": stroke.linestyle, "lw": 1.1}
            steering.plot(seconds, np.degrees(found.steering[name].action * found.largest), **look)
            omega.plot(seconds, found.steering[name].omega, **look)
        omega.set_xlabel("time (s)")
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")


def _prepare(axes: Axes, label: str, seconds: np.ndarray, unseen: np.ndarray) -> None:
    axes.set_ylabel(label)
    axes.spines[["top", "right"]].set_visible(False)
    axes.axhline(0, color=style.KERB, lw=0.7)
    axes.margins(x=0.01)
    axes.fill_between(
        seconds, 0, 1, where=unseen, step="mid", transform=axes.get_xaxis_transform(), color=style.ASPHALT, lw=0
    )
    axes.set_axisbelow(True)
