"""Drawing helpers of the figures that show a car from above, facing up."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge
from numpy.typing import NDArray
from torch import Tensor

from coil_rl.envs import Spline
from coil_rl.guides import PathPlan
from coil_rl.report import style

Array = NDArray[np.float64]

CONE_COLOURS = (style.LEFT_CONE, style.RIGHT_CONE)
LINE_COLOURS = ("#a87f00", "#174f96")  # of estimated boundaries
ADVICE_COLOUR, PATH_COLOUR = style.AGENTS[0], style.AGENTS[1]
CURVE_POINTS = 60


def output_folder(description: str | None) -> Path:
    """Return the only argument of a script, its output folder; the folder is made."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "output", type=Path, nargs="?", default=Path("outputs/figures"), help="output folder"
    )
    folder: Path = parser.parse_args().output
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def rows(points: Tensor) -> Array:
    """Return points [2, N] as [N, 2]."""
    return points.t().double().numpy()


def facing_up(points: Array) -> Array:
    """Rotate points [..., 2] from the car's frame (x ahead, y left) to the picture's (y ahead)."""
    return np.stack([-points[..., 1], points[..., 0]], -1)


def make_panel(axes: Axes, sideways: float, behind: float, ahead: float) -> None:
    """Set the limits of a panel in m and remove its frame."""
    axes.set_aspect("equal")
    axes.set(xlim=(-sideways, sideways), ylim=(-behind, ahead), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def draw_field_of_view(axes: Axes, sight: float, half_angle: float) -> None:
    """Draw the visible sector, `sight` m deep and `half_angle` radians to either side."""
    half = math.degrees(half_angle)
    axes.add_patch(
        Wedge(
            (0, 0),
            sight,
            90 - half,
            90 + half,
            fc=style.BACKGROUND,
            ec="none",
            alpha=0.55,
            zorder=1.5,
        )
    )
    axes.add_patch(
        Wedge((0, 0), sight, 90 - half, 90 + half, fc="none", ec=style.QUIET, lw=0.8, zorder=2)
    )


def draw_boundary(axes: Axes, boundary: Spline, side: int, valid: bool, samples: Array) -> None:
    """Draw the boundary estimate of a side, and its samples.

    Args:
        side: 0 for left, 1 for right.
        valid: whether there is an estimate; without one the samples are remembered, and hollow.
        samples: [5, 2] m.
    """
    colour = LINE_COLOURS[side]
    if valid:
        curve = boundary.equidistant(CURVE_POINTS)[:, :, side, 0]
        axes.plot(*facing_up(rows(curve)).T, color=colour, lw=1.4, zorder=4.5)
    face, edge = (colour, style.BACKGROUND) if valid else (style.BACKGROUND, colour)
    axes.plot(*facing_up(samples).T, "D", ms=4.4, mfc=face, mec=edge, mew=0.8, zorder=6)


def draw_plan(axes: Axes, plan: PathPlan) -> None:
    """Draw the midpoints, path and targets of a guide's plan."""
    pairs = int(plan.midpoint_count)
    in_use = None if pairs > 1 else 0
    selected = plan.nearest_target()[:, : int(not plan.excluded.all())]

    def points(places: Tensor) -> Array:
        return facing_up(rows(places)).T

    axes.plot(
        *points(plan.path.equidistant(CURVE_POINTS)[:, :in_use, 0]),
        color=PATH_COLOUR,
        lw=1.6,
        zorder=5,
    )
    axes.plot(
        *points(plan.midpoints[:, :pairs, 0]), "x", color=style.INK, ms=3.6, mew=0.9, zorder=6
    )
    targets = points(plan.targets[:, :in_use, 0])
    axes.plot(*targets, "o", ms=4.2, mfc=PATH_COLOUR, mec=style.BACKGROUND, mew=0.6, zorder=7)
    axes.plot(*points(selected), "o", ms=9, mfc="none", mec=ADVICE_COLOUR, mew=1.6, zorder=8)


def draw_advice(axes: Axes, degrees: float, length: float) -> None:
    """Draw the advised steering angle as an arrow of `length` m, and as text."""
    angle = math.radians(degrees)
    tip = (-length * math.sin(angle), length * math.cos(angle))
    arrow = {"arrowstyle": "-|>", "color": ADVICE_COLOUR, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tip, (0, 0), arrowprops=arrow, zorder=8.5)
    if abs(degrees) < 0.5:
        text = "straight on"
    else:
        text = f"{abs(degrees):.0f}° {'left' if degrees > 0 else 'right'}"
    axes.text(
        1,
        0.02,
        f"advice: {text}",
        ha="right",
        color=ADVICE_COLOUR,
        weight="bold",
        transform=axes.transAxes,
    )


def marker(symbol: str, label: str, size: float = 5.5, **options: Any) -> Line2D:
    """Return the legend handle of a marker."""
    return Line2D([], [], ls="", marker=symbol, ms=size, label=label, **options)


def common_handles() -> list[Artist]:
    """Return the legend handles of boundaries, plan and advice."""
    path: Any = {
        "color": PATH_COLOUR,
        "lw": 1.6,
        "marker": "o",
        "ms": 4.2,
        "mec": style.BACKGROUND,
        "mew": 0.6,
    }
    return [
        Line2D(
            [],
            [],
            color=LINE_COLOURS[1],
            lw=1.5,
            marker="D",
            ms=4.2,
            label="boundary estimate, its samples",
        ),
        marker("x", "midpoint of a pair", 4, mec=style.INK),
        Line2D([], [], label="guide's path, targets", **path),
        marker("o", "steered for", 8, mfc="none", mec=ADVICE_COLOUR, mew=1.6),
        Line2D(
            [], [], color=ADVICE_COLOUR, lw=1.8, marker=">", ms=4.5, markevery=[1], label="advice"
        ),
    ]
