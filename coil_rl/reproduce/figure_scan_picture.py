"""The picture of `FigureScan`: what lies ahead of the robot, from above, the robot facing up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from numpy.typing import NDArray

from coil_rl.envs import Perception
from coil_rl.envs.robot.course import OUTLINE
from coil_rl.report import style
from coil_rl.report.style import picture
from coil_rl.reproduce.facing_up import (
    CONES,
    LINES,
    draw_advice,
    draw_plan,
    draw_samples,
    draw_sight,
    mark,
    plan_handles,
    up,
)
from coil_rl.reproduce.figure_scan_look import Look

HEIGHT = 6.4  # inches
SIDEWAYS, BEHIND, AHEAD = 0.95, 0.2, 1.08  # m that are shown
ARROW = 0.28  # m
WRONG = "#aa3377"


def draw(look: Look, numbers: NDArray[np.int64], perception: Perception, path: Path, title: str) -> None:
    """Draw it.

    Args:
        look: what is drawn.
        numbers: what the clusters are called, [C].
        perception: that found them.
        path: the picture, 8 inches wide.
        title: above it.
    """
    with picture(path, title, _handles(look), HEIGHT) as figure:
        axes = figure.add_subplot()
        axes.set_aspect("equal")
        axes.set(xlim=(-SIDEWAYS, SIDEWAYS), ylim=(-BEHIND, AHEAD), xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        axes.set_facecolor(style.ASPHALT)
        draw_sight(axes, perception.range_max, perception.bearing_max)
        for centre, radius, thick in zip(up(look.cones), look.radius, look.thick, strict=True):
            axes.add_patch(Circle(tuple(centre), radius, fc=CONES[int(thick)], ec="none", alpha=0.35, zorder=2.5))
        _draw_clusters(axes, look, numbers)
        for side in (0, 1):
            _draw_side(axes, look, side)
        draw_plan(axes, look.plan)
        length, width = OUTLINE
        axes.add_patch(
            Rectangle((-width / 2, -length / 2), width, length, fc=style.INK, ec=style.BACKGROUND, zorder=8.2)
        )
        draw_advice(axes, look.advice, ARROW)


def _draw_clusters(axes: Axes, look: Look, numbers: NDArray[np.int64]) -> None:
    axes.plot(*up(look.returns).T, ".", ms=3, color=style.KERB, zorder=3)
    called = np.where(look.cluster < 0, -1, (look.decision > 0)[look.cluster])
    for kind, colour in enumerate(LINES):
        axes.plot(*up(look.points[called == kind]).T, ".", ms=5, color=colour, zorder=3.5)
    place = up(look.clusters.centroid)
    axes.plot(*place[look.wrong].T, "o", ms=19, mfc="none", mec=WRONG, mew=1.6, zorder=9)
    # Beyond the cone, as the robot sees it.
    out = place / np.hypot(*place.T)[:, None] * np.where((look.decision > 0) | look.wrong, 26, 16)[:, None]
    for cluster in np.flatnonzero(look.in_sight):
        axes.annotate(
            str(numbers[cluster]), place[cluster], out[cluster], textcoords="offset points", ha="center", va="center",
            size=8.5, zorder=10,
        )  # fmt: skip


def _draw_side(axes: Axes, look: Look, side: int) -> None:
    axes.plot(*up(look.estimate[side]).T, color=LINES[side], lw=1.3, zorder=4.5)
    if look.known[side]:
        draw_samples(axes, look.samples[side], side, fresh=len(look.estimate[side]) > 0)


def _handles(look: Look) -> list[Artist]:
    handles: list[Artist] = [
        mark("o", "thin cone", 7, mfc=CONES[0], mec="none", alpha=0.35),
        mark("o", "thick cone", 12, mfc=CONES[1], mec="none", alpha=0.35),
        mark(".", "returns called thin", 6, color=LINES[0]),
        mark(".", "returns called thick", 6, color=LINES[1]),
        mark(".", "other returns", 4, color=style.KERB),
        Line2D([], [], color=LINES[1], lw=1.3, marker="D", ms=4.2, label="boundary estimate, its samples"),
    ]
    if look.wrong.any():
        handles.append(mark("o", "taken for the other kind", 11, mfc="none", mec=WRONG, mew=1.6))
    return [*handles, *plan_handles()]
