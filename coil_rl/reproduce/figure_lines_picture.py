"""The picture of driven lines: tracks straightened, so that it shows who keeps to the middle and who cuts corners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from coil_rl.envs.track import SIDES, Track
from coil_rl.listening.sections import LEFT, RIGHT
from coil_rl.report import style
from coil_rl.report.straightened import Straightened
from coil_rl.report.style import lighten, picture
from coil_rl.train.evaluation import EvaluationResult

Array = NDArray[np.float64]

WIDTHS, HEIGHTS = (1.0, 3.2), (1.8, 0.8)  # of map and strips; of the straightened track and the smoothness below it
ROW = 2.3  # inches
HEADER = 0.75
EDGE = 1.5  # m, to either side of the middle
INSIDE = "#eceff2"
SMOOTHED = 1.0  # m, of the smoothness
MARKS = 20  # m


def draw_straightened(
    tracks: Sequence[Track],
    straightened: Sequence[Straightened],
    drives: Mapping[str, EvaluationResult],
    path: Path,
    title: str,
) -> None:
    """Draw the last lap of every driver on every track, and how smoothly it was steered there.

    Args:
        tracks: at least one.
        straightened: each of them.
        drives: by driver, of a car on each track.
        path: the picture.
        title: above it.
    """
    strokes = style.strokes(drives)
    handles: list[Artist] = [
        Line2D([], [], color=s.colour, ls=s.linestyle, lw=1.8, label=label) for label, s in strokes.items()
    ]
    for side, colour in (("left", style.LEFT_CONE), ("right", style.RIGHT_CONE)):
        handles.append(_dot("o", colour, f"{side} cones"))
    handles.append(Patch(fc=INSIDE, label="inside of a turn"))
    if any(episode["crashed"] for drive in drives.values() for episode in drive.episodes):
        handles.append(_dot("X", style.INK, "crash"))
    with picture(path, title, handles, HEADER + len(tracks) * ROW) as figure:
        grid = figure.add_gridspec(2 * len(tracks), 2, width_ratios=WIDTHS, height_ratios=HEIGHTS * len(tracks))
        for index, (track, straight) in enumerate(zip(tracks, straightened, strict=True)):
            _draw_map(figure.add_subplot(grid[2 * index : 2 * index + 2, 0]), track, straight)
            above = figure.add_subplot(grid[2 * index, 1])
            below = figure.add_subplot(grid[2 * index + 1, 1], sharex=above)
            _draw_track(above, track, straight)
            _lighten(below)
            for label, drive in drives.items():
                colour, dash = strokes[label].colour, strokes[label].linestyle
                along, aside, rough = last_lap(straight, drive.lines[index], drive.smoothness[index])
                above.plot(along, aside, color=colour, ls=dash, lw=1.2, zorder=4)
                below.plot(along, rough, color=colour, ls=dash, lw=1.0)
                if drive.episodes[index]["crashed"] and len(along):
                    above.plot(along[-1], aside[-1], "X", ms=7, mfc=colour, mec=style.BACKGROUND, mew=0.8, zorder=5)
            below.set_ylim(bottom=0)
            below.set_ylabel("smoothness", size=8)
            below.set_xlabel("along the middle (m)" if index == len(tracks) - 1 else "", size=8)


def last_lap(straight: Straightened, line: Array, smoothness: Array) -> tuple[Array, Array, Array]:
    """The last lap of a line, as far as it got.

    Args:
        straight: of its track.
        line: [T, 2] m.
        smoothness: [T].

    Returns:
        Along and aside the middle line m, and the smoothness, averaged over a few steps, each [S]; a row of NaN parts
        what lies at the two ends of the picture.
    """
    along, aside = straight(line)
    way = np.unwrap(along, period=straight.length)
    last = way > way[-1:] - straight.length
    step = float(np.median(np.linalg.norm(np.diff(line, axis=0), axis=1))) if len(line) > 1 else SMOOTHED
    rough = gaussian_filter1d(smoothness, SMOOTHED / step) if len(line) else smoothness
    shown = [of[last] for of in (along, aside, rough)]
    across = np.flatnonzero(np.abs(np.diff(shown[0])) > straight.length / 2) + 1
    along, aside, rough = (np.insert(of, across, np.nan) for of in shown)
    return along, aside, rough


def _draw_map(axes: Axes, track: Track, straight: Straightened) -> None:
    axes.set_title(track.name, size=9, color=style.QUIET)
    axes.set_aspect("equal")
    axes.axis("off")
    for side in SIDES:
        ring = track.boundary(side, 0.2)
        axes.plot(*np.vstack([ring, ring[:1]]).T, color=style.KERB, lw=0.8)
    marks = np.arange(0, straight.length - MARKS / 2, MARKS)
    for mark in marks:
        x, y = straight.line[np.searchsorted(straight.along, mark)]
        axes.plot(x, y, "o", ms=2.5, color=style.INK)
        axes.annotate(f"{mark:.0f}", (x, y), xytext=(3, 3), textcoords="offset points", size=7)


def _draw_track(axes: Axes, track: Track, straight: Straightened) -> None:
    for kind, side in ((LEFT, EDGE), (RIGHT, -EDGE)):
        axes.fill_between(straight.along, 0, side, where=straight.kinds == kind, color=INSIDE, lw=0, zorder=1)
    axes.axhline(0, color=style.KERB, lw=0.6, zorder=2)
    for cones, colour in ((track.left, style.LEFT_CONE), (track.right, style.RIGHT_CONE)):
        axes.plot(*straight(cones), "o", ms=3, mfc=colour, mec=style.INK, mew=0.3, zorder=3)
    axes.set(xlim=(0, straight.length), ylim=(-EDGE, EDGE), yticks=(-1, 0, 1))
    _lighten(axes)
    axes.tick_params(labelbottom=False)
    axes.set_ylabel("left (m)", size=8)


def _lighten(axes: Axes) -> None:
    lighten(axes)
    axes.tick_params(length=0, labelsize=7)


def _dot(marker: str, colour: str, label: str) -> Line2D:
    return Line2D([], [], ls="", marker=marker, ms=5, mfc=colour, mec=style.INK, mew=0.4, label=label)
