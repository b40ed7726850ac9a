"""Draw the view of a car in the cone world, and its guide's plan, at four moments of a drive.

There are four moments of the guide's drive. The car faces up in each panel. Cones within 7 m and 60
degrees of the heading are in sight. A smoothing spline through the cones of a side estimates that
boundary; five samples of each are the observation (distance and bearing). With fewer than two cones
in sight, the last samples are remembered as places in the world. The guide pairs left and right
cones into midpoints, fits a smoother spline through them and steers for a target on it.

    python -m coil_paper.figures.world [OUTPUT FOLDER]
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch, Polygon, Wedge
from matplotlib.path import Path as Outline

from coil_paper.reproduce.figures import Array, Figure19, facing_up, visible
from coil_rl import SplineGuide, Track
from coil_rl.envs import HALF_FIELD_OF_VIEW, SAMPLES, SIGHT, Frame
from coil_rl.guides import PathPlan
from coil_rl.report import style

TRACK = "test_3"
MOMENTS = {"straight": 10.5, "right bend": 17.5, "left bend": 4.75, "left boundary lost": 5.33}  # s
CAR = np.array([[0.0, 0.7], [-0.42, -0.5], [0.0, -0.25], [0.42, -0.5]])  # m
CONE_COLOURS = (style.LEFT_CONE, style.RIGHT_CONE)
LINE_COLOURS = ("#a87f00", "#174f96")  # of estimated boundaries
ADVICE, PATH = style.AGENTS[0], style.AGENTS[1]
CURVE_POINTS = 60

EDGE: Any = {"mec": style.INK, "mew": 0.5}
TARGETS: Any = {"marker": "o", "ms": 4.2, "mec": style.BACKGROUND, "mew": 0.6}
STEERED_FOR: Any = {"mfc": "none", "mec": ADVICE, "mew": 1.6}


@torch.no_grad()
def draw_moment(axes: Axes, name: str, seconds: float) -> None:
    """Draw the track, the view and the guide's plan of the car at a moment."""
    axes.set_title(f"{name}, after {seconds:.2f} s", size=9, loc="left", color=style.QUIET)
    axes.set_aspect("equal")
    axes.set(xlim=(-6.7, 6.7), ylim=(-1.3, 7.6), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    moment = Figure19(TRACK, seconds)
    env, state = moment.drive()
    cones, count, frame = state["cones"], state["cone_count"], Frame(env.pose.double())
    draw_surroundings(axes, moment.track, frame)
    boundary = env.boundaries.fit(cones.permute(3, 2, 1, 0), count.t())
    curves = boundary.equidistant(CURVE_POINTS)[..., 0].unbind(2)
    samples = frame.to_car(env.samples.double())[..., 0].unbind(2)
    for side, seen in enumerate(visible(cones[0], count[0]).values()):
        axes.plot(*seen.T, "o", ms=7.5, mfc=CONE_COLOURS[side], zorder=4, **EDGE)
        if env.sampled[side, 0] > 0:
            curve = facing_up(curves[side]) if len(seen) > 1 else None
            draw_boundary(axes, curve, facing_up(samples[side]), side)
    draw_plan(axes, SplineGuide().plan(cones, count))
    axes.add_patch(Polygon(CAR, fc=style.INK, ec=style.BACKGROUND, lw=0.6, zorder=9))
    draw_advice(axes, float(state["action"]) * SplineGuide().max_steering)


def draw_surroundings(axes: Axes, track: Track, frame: Frame) -> None:
    """Draw the track with its cones as the car sees it, and the field of view."""

    def local(points: Array) -> Array:
        return facing_up(frame.to_car(torch.tensor(points.T)))

    # The inner ring becomes a hole if the two run in opposite directions.
    rings = [local(track.boundary("left", 0.1)), local(track.boundary("right", 0.1))[::-1]]
    surface = Outline.make_compound_path(
        *(Outline(np.vstack([ring, ring[:1]]), closed=True) for ring in rings)
    )
    axes.add_patch(PathPatch(surface, fc=style.ASPHALT, ec=style.KERB, lw=0.6, zorder=1))
    half = math.degrees(HALF_FIELD_OF_VIEW)
    sector: Any = {"fc": (style.BACKGROUND, 0.55), "ec": style.QUIET, "lw": 0.8, "zorder": 1.5}
    axes.add_patch(Wedge((0, 0), SIGHT, 90 - half, 90 + half, **sector))
    for cones, colour in zip((track.left, track.right), CONE_COLOURS, strict=True):
        axes.plot(*local(cones).T, "o", ms=5, mfc=style.BACKGROUND, mec=colour, mew=1.1, zorder=3)


def draw_boundary(axes: Axes, curve: Array | None, samples: Array, side: int) -> None:
    """Draw the boundary estimate of a side, and its samples with the numbers of first and last.

    Args:
        curve: the estimate, [N, 2] m; None without one: then the samples are remembered, and
            hollow.
        samples: [5, 2] m.
        side: 0 for left, 1 for right.
    """
    colour, along = LINE_COLOURS[side], np.gradient(samples, axis=0)
    face, edge = style.BACKGROUND, colour
    if curve is not None:
        axes.plot(*curve.T, color=colour, lw=1.4, zorder=4.5)
        face, edge = edge, face
    axes.plot(*samples.T, "D", ms=4.4, mfc=face, mec=edge, mew=0.8, zorder=6)
    outward = np.stack([-along[:, 1], along[:, 0]], 1) * (1, -1)[side]
    outward /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    for index in (0, SAMPLES - 1):
        axes.annotate(
            str(SAMPLES * side + index + 1),
            samples[index],
            8 * outward[index],
            textcoords="offset points",
            ha="center",
            va="center",
            size=7.5,
            color=colour,
            annotation_clip=True,
            zorder=10,
        )


def draw_plan(axes: Axes, plan: PathPlan) -> None:
    """Draw the midpoints, path and targets of a guide's plan."""
    pairs = int(plan.midpoint_count)
    in_use = None if pairs > 1 else 0
    path = facing_up(plan.path.equidistant(CURVE_POINTS)[:, :in_use, 0])
    axes.plot(*path.T, color=PATH, lw=1.6, zorder=5)
    midpoints = facing_up(plan.midpoints[:, :pairs, 0])
    axes.plot(*midpoints.T, "x", color=style.INK, ms=3.6, mew=0.9, zorder=6)
    targets = facing_up(plan.targets[:, :in_use, 0])
    axes.plot(*targets.T, ls="", mfc=PATH, zorder=7, **TARGETS)
    selected = facing_up(plan.nearest_target()[:, : int(not plan.excluded.all())])
    axes.plot(*selected.T, "o", ms=9, zorder=8, **STEERED_FOR)


def draw_advice(axes: Axes, degrees: float) -> None:
    """Draw the advised steering angle as an arrow of 2 m, and as text."""
    angle, text = math.radians(degrees), "straight on"
    tip = (-2 * math.sin(angle), 2 * math.cos(angle))
    arrow = {"arrowstyle": "-|>", "color": ADVICE, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tip, (0, 0), arrowprops=arrow, zorder=8.5)
    if abs(degrees) >= 0.5:
        text = f"{abs(degrees):.0f}° {'left' if degrees > 0 else 'right'}"
    corner: Any = {"ha": "right", "transform": axes.transAxes}
    axes.text(1, 0.02, f"advice: {text}", color=ADVICE, weight="bold", **corner)


def marker(symbol: str, label: str, size: float = 5.5, **options: Any) -> Line2D:
    """Return the legend handle of a marker."""
    return Line2D([], [], ls="", marker=symbol, ms=size, label=label, **options)


def main() -> None:
    """Draw world.png."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "output", type=Path, nargs="?", default=Path("outputs/figures"), help="output folder"
    )
    path = parser.parse_args().output / "world.png"
    estimate: Any = {"color": LINE_COLOURS[1], "lw": 1.5, "marker": "D", "ms": 4.2}
    advice: Any = {"color": ADVICE, "lw": 1.8, "marker": ">", "ms": 4.5, "markevery": [1]}
    handles = [
        marker("o", "left cone in sight", 7, mfc=CONE_COLOURS[0], **EDGE),
        marker("o", "right cone in sight", 7, mfc=CONE_COLOURS[1], **EDGE),
        marker("o", "cone out of sight", 5, mfc=style.BACKGROUND, mec=CONE_COLOURS[1]),
        Patch(fc=style.BACKGROUND, ec=style.QUIET, lw=0.8, label="field of view"),
        marker("D", "remembered sample", 4.2, mfc=style.BACKGROUND, mec=LINE_COLOURS[0]),
        Line2D([], [], label="boundary estimate, its samples", **estimate),
        marker("x", "midpoint of a pair", 4, mec=style.INK),
        Line2D([], [], label="guide's path, targets", color=PATH, lw=1.6, **TARGETS),
        marker("o", "steered for", 8, **STEERED_FOR),
        Line2D([], [], label="advice", **advice),
    ]
    title = f"A car's view and its guide's advice ({TRACK})"
    with style.picture(path, title, handles, height=6.25) as figure:
        for axes, (name, seconds) in zip(figure.subplots(2, 2).flat, MOMENTS.items(), strict=True):
            draw_moment(axes, name, seconds)
    print(path)


if __name__ == "__main__":
    main()
