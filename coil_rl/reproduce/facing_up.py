"""What the pictures share that show a car from above, facing up: its sight, the guide's plan and the advice."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Wedge
from numpy.typing import NDArray
from torch import Tensor

from coil_rl.envs.sight import SAMPLES
from coil_rl.guides.spline import Plan, pick
from coil_rl.report import style

Array = NDArray[np.float64]

CONES = (style.LEFT_CONE, style.RIGHT_CONE)
LINES = ("#a87f00", "#174f96")  # of what is estimated from them
ADVICE, PATH = style.AGENTS[0], style.AGENTS[1]
FINE = 60  # points of a curve
EDGES: Any = {"mec": style.INK, "mew": 0.5}


def up(points: Array) -> Array:
    """Places [..., 2] in the car's frame, x ahead and y left, on a picture whose y is ahead."""
    return np.stack([-points[..., 1], points[..., 0]], -1)


def draw_sight(axes: Axes, sight: float, half_field_of_view: float) -> None:
    """Draw the sector that the car sees, `sight` m deep and so many radians to either side."""
    half = math.degrees(half_field_of_view)
    axes.add_patch(Wedge((0, 0), sight, 90 - half, 90 + half, fc=style.BACKGROUND, ec="none", alpha=0.55, zorder=1.5))
    axes.add_patch(Wedge((0, 0), sight, 90 - half, 90 + half, fc="none", ec=style.QUIET, lw=0.8, zorder=2))


def places_of(plan: Plan, scale: float = 1.0) -> dict[str, Array]:
    """What the plan of one car consists of, [N, 2] m each, N 0 for what there is not.

    Args:
        plan: of a `SplineGuide`.
        scale: the plan's metres in one of the car's own.

    Returns:
        `midpoint`, points of the `path`, `target`, and the one that is `steered for`.
    """
    pairs = int(plan.pairs)
    some = None if pairs > 1 else 0
    chosen = pick(plan.targets, plan.square, plan.barred)[:, : int(not plan.barred.all())]
    found = {
        "midpoint": plan.midpoints[:, :pairs, 0],
        "path": plan.path.equidistant(FINE)[:, :some, 0],
        "target": plan.targets[:, :some, 0],
        "steered for": chosen,
    }
    return {name: rows(points / scale) for name, points in found.items()}


def rows(points: Tensor) -> Array:
    """Points [2, N] as [N, 2]."""
    return points.t().double().numpy()


def rows_of_samples(samples: Array, observation: Array) -> Iterator[dict[str, object]]:
    """What a CSV says of the samples [2, 5, 2] m of both sides and of the observation [20] that tells of them."""
    for number, (r, theta) in enumerate(observation.reshape(-1, 2)):
        x, y = samples[divmod(number, SAMPLES)]
        yield {"part": "sample", "number": number + 1, "x": x, "y": y, "r": r, "theta": theta}


def rows_of_places(places: Mapping[str, Array]) -> Iterator[dict[str, object]]:
    """What a CSV says of places [N, 2] m by their name."""
    for part, points in places.items():
        for number, (x, y) in enumerate(points, 1):
            yield {"part": part, "number": number, "x": x, "y": y}


def draw_samples(axes: Axes, samples: Array, side: int, fresh: bool) -> None:
    """Draw the samples [5, 2] m of a side, filled if they are of now and hollow if remembered."""
    fill, edge = (LINES[side], style.BACKGROUND) if fresh else (style.BACKGROUND, LINES[side])
    axes.plot(*up(samples).T, "D", ms=4.4, mfc=fill, mec=edge, mew=0.8, zorder=6)


def draw_plan(axes: Axes, plan: Mapping[str, Array]) -> None:
    """Draw what `places_of` found."""
    axes.plot(*up(plan["path"]).T, color=PATH, lw=1.6, zorder=5)
    axes.plot(*up(plan["midpoint"]).T, "x", color=style.INK, ms=3.6, mew=0.9, zorder=6)
    axes.plot(*up(plan["target"]).T, "o", ms=4.2, mfc=PATH, mec=style.BACKGROUND, mew=0.6, zorder=7)
    axes.plot(*up(plan["steered for"]).T, "o", ms=9, mfc="none", mec=ADVICE, mew=1.6, zorder=8)


def draw_advice(axes: Axes, degrees: float, length: float) -> None:
    """Draw an arrow of so many m from the car to where it is to steer, and say in the lower right corner where to."""
    angle = math.radians(degrees)
    tip = (-length * math.sin(angle), length * math.cos(angle))
    arrow = {"arrowstyle": "-|>", "color": ADVICE, "lw": 1.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", tip, (0, 0), arrowprops=arrow, zorder=8.5)
    way = "straight on" if abs(degrees) < 0.5 else f"{abs(degrees):.0f}° {'left' if degrees > 0 else 'right'}"
    axes.text(1, 0.02, f"advice: {way}", ha="right", color=ADVICE, weight="bold", transform=axes.transAxes)


def mark(marker: str, label: str, size: float = 5.5, **how: Any) -> Line2D:
    """The handle of a marker in a legend."""
    return Line2D([], [], ls="", marker=marker, ms=size, label=label, **how)


def plan_handles() -> list[Artist]:
    """The handles of `draw_plan` and `draw_advice`."""
    return [
        mark("x", "midpoint of a pair", 4, mec=style.INK),
        Line2D(
            [], [], color=PATH, lw=1.6, marker="o", ms=4.2, mec=style.BACKGROUND, mew=0.6, label="guide's path, targets"
        ),
        mark("o", "steered for", 8, mfc="none", mec=ADVICE, mew=1.6),
        Line2D([], [], color=ADVICE, lw=1.8, marker=">", ms=4.5, markevery=[1], label="advice"),
    ]
