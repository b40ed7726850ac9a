"""The picture of `FigureWorld`: what a car sees and what the guide makes of it, a panel a moment, the car facing up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon, Wedge
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from coil_rl.envs.sight import HALF_FIELD_OF_VIEW, SAMPLES, SIGHT
from coil_rl.report import style
from coil_rl.reproduce.figure_world_look import Look
from coil_rl.reproduce.result import picture

Array = NDArray[np.float64]

COLUMNS = 2
PANEL, HEADER = 2.75, 0.75  # inches
SIDEWAYS, BEHIND, AHEAD = 6.7, 1.3, 7.6  # m that are shown
ARROW = 2.0  # m
CAR = np.array([[0.7, 0.0], [-0.5, 0.42], [-0.25, 0.0], [-0.5, -0.42]])  # m
CONES = (style.LEFT_CONE, style.RIGHT_CONE)
LINES = ("#a87f00", "#174f96")  # of what is estimated from them
ADVICE, PATH = style.AGENTS[0], style.AGENTS[1]
EDGES: Any = {"mec": style.INK, "mew": 0.5}


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
    rings = [_up(look.boundaries[0]), _up(look.boundaries[1])[::-1]]
    surface = Outline.make_compound_path(*(Outline(np.vstack([ring, ring[:1]]), closed=True) for ring in rings))
    axes.add_patch(PathPatch(surface, fc=style.ASPHALT, ec=style.KERB, lw=0.6, zorder=1))
    half = math.degrees(HALF_FIELD_OF_VIEW)
    axes.add_patch(Wedge((0, 0), SIGHT, 90 - half, 90 + half, fc=style.PAPER, ec="none", alpha=0.55, zorder=1.5))
    axes.add_patch(Wedge((0, 0), SIGHT, 90 - half, 90 + half, fc="none", ec=style.QUIET, lw=0.8, zorder=2))
    for side in (0, 1):
        _draw_side(axes, look, side)
    axes.plot(*_up(look.path).T, color=PATH, lw=1.6, zorder=5)
    axes.plot(*_up(look.midpoints).T, "x", color=style.INK, ms=3.6, mew=0.9, zorder=6)
    axes.plot(*_up(look.targets).T, "o", ms=4.2, mfc=PATH, mec=style.PAPER, mew=0.6, zorder=7)
    if look.target is not None:
        axes.plot(*_up(look.target), "o", ms=9, mfc="none", mec=ADVICE, mew=1.6, zorder=8)
    axes.add_patch(Polygon(_up(CAR), fc=style.INK, ec=style.PAPER, lw=0.6, zorder=9))
    angle = math.radians(look.advice)
    tip = (-ARROW * math.sin(angle), ARROW * math.cos(angle))
    arrow = {"arrowstyle": "-|>", "color": ADVICE, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tip, (0, 0), arrowprops=arrow, zorder=8.5)
    way = "straight on" if abs(look.advice) < 0.5 else f"{abs(look.advice):.0f}° {'left' if angle > 0 else 'right'}"
    axes.text(SIDEWAYS, -BEHIND + 0.2, f"advice: {way}", ha="right", color=ADVICE, weight="bold")


def _draw_side(axes: Axes, look: Look, side: int) -> None:
    axes.plot(*_up(look.cones[side]).T, "o", ms=5, mfc=style.PAPER, mec=CONES[side], mew=1.1, zorder=3)
    axes.plot(*_up(look.seen[side]).T, "o", ms=7.5, mfc=CONES[side], zorder=4, **EDGES)
    axes.plot(*_up(look.estimate[side]).T, color=LINES[side], lw=1.5, zorder=4.5)
    if not look.known[side]:
        return
    fill, edge = (LINES[side], style.PAPER) if look.fresh[side] else (style.PAPER, LINES[side])
    samples = _up(look.samples[side])
    axes.plot(*samples.T, "D", ms=4.4, mfc=fill, mec=edge, mew=0.8, zorder=6)
    along = np.gradient(samples, axis=0)
    out = np.stack([-along[:, 1], along[:, 0]], 1) * (1, -1)[side] / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    for place in (0, SAMPLES - 1):
        axes.annotate(
            str(SAMPLES * side + place + 1), samples[place], 8 * out[place], textcoords="offset points", ha="center",
            va="center", size=7.5, color=LINES[side], annotation_clip=True, zorder=10,
        )  # fmt: skip


def _up(points: Array) -> Array:
    """Places [..., 2] in the car's frame, x ahead and y left, on a picture whose y is ahead."""
    return np.stack([-points[..., 1], points[..., 0]], -1)


def _handles(moments: Sequence[Look]) -> list[Artist]:
    def mark(marker: str, label: str, size: float = 5.5, **how: Any) -> Line2D:
        return Line2D([], [], ls="", marker=marker, ms=size, label=label, **how)

    handles: list[Artist] = [
        mark("o", "left cone in sight", 7, mfc=CONES[0], **EDGES),
        mark("o", "right cone in sight", 7, mfc=CONES[1], **EDGES),
        mark("o", "cone out of sight", 5, mfc=style.PAPER, mec=CONES[1]),
        Patch(fc=style.PAPER, ec=style.QUIET, lw=0.8, label="sight"),
        Line2D([], [], color=LINES[1], lw=1.5, marker="D", ms=4.2, label="boundary estimate, its samples"),
    ]
    if not all(all(look.fresh) for look in moments):
        handles.append(mark("D", "remembered", 4.2, mfc=style.PAPER, mec=LINES[0]))
    return [
        *handles,
        mark("x", "midpoint of a pair", 4, mec=style.INK),
        Line2D([], [], color=PATH, lw=1.6, marker="o", ms=4.2, mec=style.PAPER, mew=0.6, label="guide's path, targets"),
        mark("o", "steered for", 8, mfc="none", mec=ADVICE, mew=1.6),
        Line2D([], [], color=ADVICE, lw=1.8, marker=">", ms=4.5, markevery=[1], label="advice"),
    ]
