"""Pictures of driven lines: where each driver went between the cones, still and moving."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from tqdm import tqdm

from coil_rl.files import whole_file
from coil_rl.report import style
from coil_rl.report.scene import Scene
from coil_rl.report.sprites import Car, draw_clock, rgb, shared_palette

if TYPE_CHECKING:
    from coil_rl.envs.track import Track

Array = NDArray[np.float64]

TAIL = 0.6  # seconds of the animation
LAST_FRAME = 1.2  # seconds
CAR = 2.0  # m
CAR_PIXELS = (11.0, 24.0)  # still seen on long tracks, out of the way on short ones


def draw_lines(
    tracks: Sequence[Track],
    lines: Mapping[str, Sequence[ArrayLike]],
    path: str | os.PathLike[str],
    *,
    crashed: Mapping[str, Sequence[bool]] | None = None,
    title: str | None = None,
) -> None:
    """Draw the lines of several drivers on several tracks, all at one scale.

    Args:
        tracks: at least one, N of them.
        lines: from driver to its N lines, each [T, 2] m, x right and y up; T may be 0, rows that are not finite are
            left out. A driver whose name starts with "guide" is drawn in grey dashes; the last one lies on top.
        path: the picture, in the format of its ending (.png, .svg, .pdf), 8 inches wide.
        crashed: from driver to N truth values; a line that ended in a crash ends in a cross.
        title: above the picture.

    Raises:
        ValueError: if there is no track, or if the lines or the truth values do not match the tracks.
    """
    driven, ended = _checked(tracks, lines, crashed)
    strokes = style.strokes(driven)
    handles = [Line2D([], [], color=s.colour, ls=s.linestyle, lw=1.8, label=label) for label, s in strokes.items()]
    scene = Scene(tracks, legend=[*handles, *_crash_handle(ended)], title=title, dpi=style.RESOLUTION)
    for z, (label, stroke) in enumerate(strokes.items()):
        for index, (track, line) in enumerate(zip(tracks, driven[label], strict=True)):
            for lap in _laps(line, track):
                at = lap + scene.offsets[index]
                scene.axes.plot(*at.T, color=stroke.colour, ls=stroke.linestyle, lw=1.4, zorder=4 + z / 100)
            if ended[label][index] and len(line):
                at = line[-1] + scene.offsets[index]
                scene.axes.plot(*at, marker="X", ms=8, mfc=stroke.colour, mec=style.PAPER, mew=0.8, zorder=5 + z / 100)
    scene.save(path)


def animate_lines(
    tracks: Sequence[Track],
    lines: Mapping[str, Sequence[ArrayLike]],
    path: str | os.PathLike[str],
    *,
    rate: float,
    crashed: Mapping[str, Sequence[bool]] | None = None,
    title: str | None = None,
    seconds: float = 12.0,
    fps: int = 20,
) -> None:
    """Let the drivers race each other on every track, as a GIF that starts over at the end.

    All of them start together; who has finished stands still at the end of its line.

    Args:
        tracks: as in `draw_lines`.
        lines: as in `draw_lines`, one row a step.
        path: the GIF, 800 px wide.
        rate: steps per second of the lines.
        crashed: as in `draw_lines`.
        title: above the picture.
        seconds: how long the longest line takes to watch, at most: no line is shown slower than it was driven.
        fps: frames per second; a GIF counts in hundredths of a second, so 20, 25 or 50 are exact.

    Raises:
        ValueError: as `draw_lines`, or if rate, seconds or fps is not above 0.
    """
    for name, value in {"rate": rate, "seconds": seconds, "fps": fps}.items():
        if not value > 0:
            raise ValueError(f"{name} must be above 0, got {value}.")
    driven, ended = _checked(tracks, lines, crashed)
    strokes = style.strokes(driven)
    handles = [Line2D([], [], ls="", marker=">", ms=8, mfc=s.colour, mec=s.colour, label=k) for k, s in strokes.items()]
    scene = Scene(tracks, legend=[*handles, *_crash_handle(ended)], title=title, dpi=style.SCREEN_RESOLUTION)
    background = Image.fromarray(scene.image())
    length = float(np.clip(CAR * scene.scale * style.SCREEN_RESOLUTION, *CAR_PIXELS))
    cars = [
        Car(scene.pixels(index, line), rgb(strokes[label].colour), length, ended[label][index])
        for label, of_label in driven.items()
        for index, line in enumerate(of_label)
        if len(line)
    ]
    duration = max((len(car.line) - 1 for car in cars), default=0) / rate
    faster = max(1.0, duration / seconds)
    times = np.linspace(0, duration, 1 + math.ceil(duration / faster * fps))
    palette = shared_palette(background, [rgb(stroke.colour) for stroke in strokes.values()])

    def frames() -> Iterator[Image.Image]:
        for time in tqdm(times, desc="animation", unit="frame", leave=False, disable=None):
            frame = background.copy()
            for car in cars:
                car.draw(frame, float(time) * rate, TAIL * faster * rate)
            draw_clock(frame, f"{time:.1f} s ({faster:.0f}× speed)" if faster >= 1.5 else f"{time:.1f} s")
            yield frame.quantize(palette=palette, dither=Image.Dither.NONE)

    moving = frames()
    pause = [round(1000 / fps)] * (len(times) - 1) + [round(1000 * LAST_FRAME)]
    with whole_file(path) as unfinished:
        next(moving).save(unfinished, format="GIF", save_all=True, append_images=moving, duration=pause, loop=0)


def _crash_handle(ended: Mapping[str, Sequence[bool]]) -> list[Line2D]:
    cross = Line2D([], [], ls="", marker="X", ms=7, mfc=style.INK, mec=style.PAPER, label="crash")
    return [cross] if any(any(marks) for marks in ended.values()) else []


def _laps(line: Array, track: Track) -> list[Array]:
    """A line cut where it crosses the finish line forwards.

    Dashes that start anew with each lap lie on those of the lap before instead of filling its gaps.
    """
    across = track.right[0] - track.left[0]
    ahead = (line - track.left[0]) @ np.array([-across[1], across[0]])
    aside = (line - track.left[0]) @ across / (across @ across)
    crosses = (ahead[:-1] < 0) & (ahead[1:] >= 0) & (aside[1:] > 0) & (aside[1:] < 1)
    cuts = [0, *(np.flatnonzero(crosses) + 1).tolist(), len(line)]
    return [line[start : stop + 1] for start, stop in itertools.pairwise(cuts)]


def _checked(
    tracks: Sequence[Track],
    lines: Mapping[str, Sequence[ArrayLike]],
    crashed: Mapping[str, Sequence[bool]] | None,
) -> tuple[dict[str, list[Array]], dict[str, list[bool]]]:
    """The finite rows of all lines, and for all drivers whether they crashed."""
    names = ", ".join(track.name for track in tracks)
    for what, given in {"lines": lines, "crash marks": crashed or {}}.items():
        for label, values in given.items():
            if len(values) != len(tracks):
                raise ValueError(
                    f"{label!r} has {len(values)} {what} for {len(tracks)} tracks ({names}); give one for each."
                )
    strangers = [label for label in crashed or {} if label not in lines]
    if strangers:
        raise ValueError(
            f"There are crash marks of {strangers[0]!r} but no lines; lines are given of: {', '.join(lines)}."
        )
    driven: dict[str, list[Array]] = {}
    for label, of_label in lines.items():
        driven[label] = []
        for track, line in zip(tracks, of_label, strict=True):
            points = np.asarray(line, dtype=np.float64)
            if points.size == 0:
                points = points.reshape(0, 2)
            if points.ndim != 2 or points.shape[1] != 2:
                raise ValueError(
                    f"The line of {label!r} on {track.name!r} has the shape {list(points.shape)}; it takes [T, 2]."
                )
            driven[label].append(points[np.isfinite(points).all(axis=1)])
    ended = {label: [bool(mark) for mark in (crashed or {}).get(label, [False] * len(tracks))] for label in lines}
    return driven, ended
