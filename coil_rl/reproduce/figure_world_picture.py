"""The picture of `FigureWorld`: what a car sees and what the guide makes of it, a panel a moment, the car facing up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon
from matplotlib.path import Path as Outline

from coil_rl.envs.sight import HALF_FIELD_OF_VIEW, SAMPLES, SIGHT
from coil_rl.report import style
from coil_rl.report.style import picture
from coil_rl.reproduce.facing_up import (
    CONES,
    EDGES,
    LINES,
    draw_advice,
    draw_plan,
    draw_samples,
    draw_sight,
    mark,
    plan_handles,
    up,
)
from coil_rl.reproduce.figure_world_look import Look

COLUMNS = 2
PANEL, HEADER = 2.75, 0.75  # inches
SIDEWAYS, BEHIND, AHEAD = 6.7, 1.3, 7.6  # m that are shown
ARROW = 2.0  # m
CAR = np.array([[0.7, 0.0], [-0.5, 0.42], [-0.25, 0.0], [-0.5, -0.42]])  # m


def draw(moments: Sequence[Look], path: Path, title: str) -> None:
    """Draw it.

    Args:
        moments: one panel each.
        path: the picture, 8 inches wide.
        title: above it.
    """
    rows = -(-len(moments) // COLUMNS)
    with picture(path, title, _handles(moments), HEADER + rows * PANEL) as figure:
        panels = list(figure.subplots(rows, COLUMNS, squeeze=False).flat)
        for axes, look in zip(panels, moments, strict=False):
            _draw_panel(axes, look)
        for axes in panels[len(moments) :]:
            axes.axis("off")


def _draw_panel(axes: Axes, look: Look) -> None:
    axes.set_aspect("equal")
    axes.set(xlim=(-SIDEWAYS, SIDEWAYS), ylim=(-BEHIND, AHEAD), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(f"{look.name}, after {look.seconds:.2f} s", size=9, loc="left", color=style.QUIET)
    # Turning one ring around makes it a hole in the other, whichever is the inner one.
    rings = [up(look.boundaries[0]), up(look.boundaries[1])[::-1]]
    surface = Outline.make_compound_path(*(Outline(np.vstack([ring, ring[:1]]), closed=True) for ring in rings))
    axes.add_patch(PathPatch(surface, fc=style.ASPHALT, ec=style.KERB, lw=0.6, zorder=1))
    draw_sight(axes, SIGHT, HALF_FIELD_OF_VIEW)
    for side in (0, 1):
        _draw_side(axes, look, side)
    draw_plan(axes, look.plan)
    axes.add_patch(Polygon(up(CAR), fc=style.INK, ec=style.BACKGROUND, lw=0.6, zorder=9))
    draw_advice(axes, look.advice, ARROW)


def _draw_side(axes: Axes, look: Look, side: int) -> None:
    axes.plot(*up(look.cones[side]).T, "o", ms=5, mfc=style.BACKGROUND, mec=CONES[side], mew=1.1, zorder=3)
    axes.plot(*up(look.seen[side]).T, "o", ms=7.5, mfc=CONES[side], zorder=4, **EDGES)
    axes.plot(*up(look.estimate[side]).T, color=LINES[side], lw=1.5, zorder=4.5)
    if not look.known[side]:
        return
    draw_samples(axes, look.samples[side], side, look.fresh[side])
    samples = up(look.samples[side])
    along = np.gradient(samples, axis=0)
    out = np.stack([-along[:, 1], along[:, 0]], 1) * (1, -1)[side] / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    for place in (0, SAMPLES - 1):
        axes.annotate(
            str(SAMPLES * side + place + 1), samples[place], 8 * out[place], textcoords="offset points", ha="center",
            va="center", size=7.5, color=LINES[side], annotation_clip=True, zorder=10,
        )  # fmt: skip


def _handles(moments: Sequence[Look]) -> list[Artist]:
    handles: list[Artist] = [
        mark("o", "left cone in sight", 7, mfc=CONES[0], **EDGES),
        mark("o", "right cone in sight", 7, mfc=CONES[1], **EDGES),
        mark("o", "cone out of sight", 5, mfc=style.BACKGROUND, mec=CONES[1]),
        Patch(fc=style.BACKGROUND, ec=style.QUIET, lw=0.8, label="sight"),
        Line2D([], [], color=LINES[1], lw=1.5, marker="D", ms=4.2, label="boundary estimate, its samples"),
    ]
    if not all(all(look.fresh) for look in moments):
        handles.append(mark("D", "remembered", 4.2, mfc=style.BACKGROUND, mec=LINES[0]))
    return [*handles, *plan_handles()]
