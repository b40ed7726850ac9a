"""The picture of `FigureSpline`: the curves on the map, and how much they bend."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from coil_rl.report import style
from coil_rl.report.style import lighten, picture

if TYPE_CHECKING:
    from coil_rl.reproduce.figure_spline import Fit

Array = NDArray[np.float64]

HEIGHT = 6.2  # inches
EVERY = 8  # of so many points of SciPy's curve one is drawn


def draw(fits: Sequence[Fit], points: Array, truth: Array, path: Path, title: str) -> None:
    """Draw it.

    Args:
        fits: one curve each.
        points: noisy, [N, 2] m.
        truth: without noise, [N, 2] m.
        path: the picture, 8 inches wide.
        title: above it.
    """
    strokes = style.strong_strokes(f"λ = {fit.smoothing:g}" for fit in fits)
    handles: list[Artist] = [
        Line2D([], [], color=stroke.colour, ls=stroke.linestyle, lw=1.8, label=label)
        for label, stroke in strokes.items()
    ]
    handles += [
        Line2D([], [], ls="", marker=".", ms=4, color=style.INK, label="SciPy's, all λ"),
        Line2D([], [], ls="", marker="o", ms=7, mfc="none", mec=style.INK, mew=0.9, label="noisy cone"),
        Line2D([], [], ls="", marker="+", ms=6, color=style.QUIET, label="true cone"),
    ]
    with picture(path, title, handles, HEIGHT) as figure:
        plane, bends = figure.subplots(2, 1, height_ratios=(2.3, 1))
        plane.set_aspect("equal", adjustable="datalim")
        plane.set(xlabel="m", ylabel="m")
        lighten(plane)
        plane.plot(*truth.T, "+", ms=6, color=style.QUIET, zorder=2)
        plane.plot(*points.T, "o", ms=7.5, mfc="none", mec=style.INK, mew=0.9, zorder=5)
        chords = np.hypot(*np.diff(points, axis=0).T)
        travelled = np.concatenate([[0], chords.cumsum()])
        for fit, stroke in zip(fits, strokes.values(), strict=True):
            line = {"color": stroke.colour, "ls": stroke.linestyle, "lw": 1.8}
            plane.plot(*fit.curve.T, zorder=3, **line)
            plane.plot(*fit.scipy[::EVERY].T, ".", ms=2.2, color=style.INK, zorder=4)
            bends.plot(travelled, fit.bends, **line)
            bends.plot(travelled, fit.scipy_bends, ".", ms=3, color=style.INK, zorder=4)
        bends.set(xlabel="u, chord length from point to point (m)", ylabel="|f''| (1/m)", xlim=(0, travelled[-1]))
        bends.set_ylim(bottom=0)
        lighten(bends)
