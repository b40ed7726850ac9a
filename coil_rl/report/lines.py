"""Driven lines on a map of the tracks: still, animated, or coloured by a measure."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal
from matplotlib.patheffects import Stroke as StrokeEffect
from numpy.typing import ArrayLike
from PIL import Image
from tqdm import tqdm

from coil_rl.files import whole_file
from coil_rl.report import style
from coil_rl.report.track_plot import Array, TrackPlot

if TYPE_CHECKING:
    from coil_rl.envs.track import Track

GIF_RESOLUTION = 100  # dpi
TAIL = 0.6  # seconds of the animation
FPS = 20  # GIFs count in hundredths of a second: 20, 25 and 50 are exact
PAUSE = 1.2  # seconds at the end of the animation
CAR: dict[str, Any] = {"marker": "o", "ms": 6.5, "mec": style.BACKGROUND, "mew": 1.0, "ls": ""}
CRASH: dict[str, Any] = {"marker": "X", "ms": 8, "mec": style.BACKGROUND, "mew": 0.8, "ls": ""}

# Readable without colours, and different from those of the cones.
MEASURE_COLOURS = ListedColormap(mpl.colormaps["magma_r"](np.linspace(0.02, 0.88, 256)))


def draw_lines(
    tracks: Sequence[Track],
    lines: Mapping[str, Sequence[ArrayLike]],
    path: str | os.PathLike[str],
    *,
    crashed: Mapping[str, Sequence[bool]] | None = None,
) -> None:
    """Draw the lines of several drivers on several tracks, all at one scale.

    Args:
        tracks: N of them, at least one.
        lines: N lines per driver, each [T, 2] m, x right and y up; T may be 0, rows that are not
            finite are left out. Drivers whose name starts with "guide" are drawn in grey dashes;
            the last driver is on top.
        path: output file, 8 inches wide.
        crashed: per driver, whether each of the N lines ended in a crash; a cross marks it.
    """
    driven, ended = _finite(lines), crashed or {}
    strokes = style.strokes(driven)
    handles = [
        Line2D([], [], color=s.colour, ls=s.linestyle, lw=1.8, label=label)
        for label, s in strokes.items()
    ]
    plot = TrackPlot(tracks, legend=[*handles, *_crash_handle(ended)])
    for z, (label, stroke) in enumerate(strokes.items()):
        for index, (track, line) in enumerate(zip(tracks, driven[label], strict=True)):
            offset = plot.offsets[index]
            for lap in _split_laps(line, track):
                xy = (lap + offset).T
                plot.axes.plot(
                    *xy, color=stroke.colour, ls=stroke.linestyle, lw=1.4, zorder=4 + z / 100
                )
            if label in ended and ended[label][index] and len(line):
                plot.axes.plot(*(line[-1] + offset), mfc=stroke.colour, zorder=5 + z / 100, **CRASH)
    style.save(plot.figure, path)


def animate_lines(
    tracks: Sequence[Track],
    lines: Mapping[str, Sequence[ArrayLike]],
    path: str | os.PathLike[str],
    *,
    rate: float,
    crashed: Mapping[str, Sequence[bool]] | None = None,
    seconds: float = 12.0,
) -> None:
    """Write a GIF, 800 px wide, in which all drivers drive on all tracks at the same time; it repeats.

    The arguments are those of `draw_lines`, the `rate` of the lines in steps per second, and the
    maximum duration in `seconds`; lines are never shown slower than they were driven.
    """
    driven, ended = _finite(lines), crashed or {}
    colours = {label: stroke.colour for label, stroke in style.strokes(driven).items()}
    handles = [Line2D([], [], mfc=colour, label=label, **CAR) for label, colour in colours.items()]
    plot = TrackPlot(tracks, legend=[*handles, *_crash_handle(ended)], dpi=GIF_RESOLUTION)
    figure, axes, canvas = plot.figure, plot.axes, plot.canvas
    with mpl.rc_context(style.LETTERS):
        right = 1 - style.MARGIN / style.WIDTH
        clock = figure.text(right, 14 / figure.bbox.height, "", size=8, ha="right", va="center")
        cars = []
        for label, index in itertools.product(driven, range(len(tracks))):
            (tail,) = axes.plot([], [], color=colours[label], lw=2.4, alpha=0.6)
            (head,) = axes.plot([], [], mfc=colours[label], **CAR)
            crashes = label in ended and ended[label][index]
            cars.append((driven[label][index] + plot.offsets[index], crashes, tail, head))
        canvas.draw()
    # Drawing the tracks in every frame would take three times as long.
    background = canvas.copy_from_bbox(figure.bbox)
    duration = (max([1, *(len(line) for line, *_ in cars)]) - 1) / rate
    speed = max(1.0, duration / seconds)
    times = np.linspace(0, duration, 1 + math.ceil(duration / speed * FPS)).tolist()

    def frames() -> Iterator[Image.Image]:
        for time in tqdm(times, desc="animation", unit="frame", leave=False, disable=None):
            canvas.restore_region(background)
            for line, crashes, tail, head in cars:
                now, start = (
                    min(round(time * rate), len(line) - 1),
                    round((time - TAIL * speed) * rate),
                )
                tail.set_data(*line[max(0, start) : now + 1].T)
                head.set_data(*line[max(0, now) : now + 1].T)
                if crashes and now == len(line) - 1:
                    head.set(marker=CRASH["marker"], markersize=CRASH["ms"])
                axes.draw_artist(tail)
                axes.draw_artist(head)
            clock.set_text(
                f"{time:.1f} s ({speed:.0f}× speed)" if speed >= 1.5 else f"{time:.1f} s"
            )
            figure.draw_artist(clock)
            yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")

    images = frames()
    first = next(images).quantize(
        method=Image.Quantize.FASTOCTREE
    )  # its legend has the colours of all drivers
    others = (image.quantize(palette=first, dither=Image.Dither.NONE) for image in images)
    durations = [round(1000 / FPS)] * (len(times) - 1) + [round(1000 * PAUSE)]
    with whole_file(path) as unfinished:
        first.save(
            unfinished,
            format="GIF",
            save_all=True,
            append_images=others,
            duration=durations,
            loop=0,
        )


def draw_listening_map(
    tracks: Sequence[Track],
    lines: Sequence[ArrayLike],
    values: Mapping[str, Sequence[ArrayLike]],
    path: str | os.PathLike[str],
    *,
    label: str,
    title: str | None = None,
) -> None:
    """Draw the driven lines once per guide, coloured by a measure on one colour scale.

    Args:
        tracks: N of them, at least one.
        lines: N driven lines, [T, 2] m each, T at least 1.
        values: by guide, at least one, the values at the points of each line, N times [T]; NaN is
            left out.
        path: output file.
        label: of the colour bar, measure and unit.
        title: above the map.
    """
    highest = (
        float(np.nanmax([0.0, *np.concatenate([row for rows in values.values() for row in rows])]))
        or 1.0
    )
    colours = ScalarMappable(Normalize(0, highest), MEASURE_COLOURS)
    panels = [(guide, index) for guide in values for index in range(len(tracks))]
    titled = [
        replace(tracks[index], name=f"{guide}: {tracks[index].name}") for guide, index in panels
    ]
    plot = TrackPlot(titled, title=title, groups=len(values))
    rim = [StrokeEffect(linewidth=5.2, foreground=style.BACKGROUND), Normal()]
    for panel, (guide, index) in enumerate(panels):
        xy = np.asarray(lines[index], dtype=np.float64) + plot.offsets[panel]
        segments = np.stack([xy[:-1], xy[1:]], axis=1)
        segment_values = np.asarray(values[guide][index], dtype=np.float64)[:-1]
        finite = np.isfinite(segment_values)
        plot.axes.add_collection(
            LineCollection(
                list(segments[finite]),
                array=segment_values[finite],
                cmap=MEASURE_COLOURS,
                norm=colours.norm,
                lw=4.0,
                capstyle="round",
                zorder=4,
                path_effects=rim,
            )
        )
    with mpl.rc_context(style.LETTERS):  # a colour bar in the lower right corner
        width, height = plot.figure.get_size_inches()
        left, bottom, bar_width, bar_height = width - style.MARGIN - 0.34 - 2.2, 0.13, 2.2, 0.11
        axes = plot.figure.add_axes(
            (left / width, bottom / height, bar_width / width, bar_height / height)
        )
        bar = plot.figure.colorbar(colours, cax=axes, orientation="horizontal")
        bar.outline.set_visible(False)
        bar.set_ticks([])
        middle = (bottom + bar_height / 2) / height
        plot.figure.text(
            (left - 0.07) / width, middle, f"{label}  0", size=8, ha="right", va="center"
        )
        axes.text(1.03, 0.5, f"{highest:.2g}", size=8, va="center", transform=axes.transAxes)
    style.save(plot.figure, path)


def _crash_handle(ended: Mapping[str, Sequence[bool]]) -> list[Line2D]:
    handle = Line2D(
        [], [], ls="", marker="X", ms=7, mfc=style.INK, mec=style.BACKGROUND, label="crash"
    )
    return [handle] if any(any(crashes) for crashes in ended.values()) else []


def _split_laps(line: Array, track: Track) -> list[Array]:
    """Split a line where it crosses the finish line forwards, so that the dashes of all laps coincide."""
    across = track.right[0] - track.left[0]
    forward = (line - track.left[0]) @ np.array([-across[1], across[0]])
    sideways = (line - track.left[0]) @ across / (across @ across)
    crosses = (forward[:-1] < 0) & (forward[1:] >= 0) & (sideways[1:] > 0) & (sideways[1:] < 1)
    cuts = [0, *(np.flatnonzero(crosses) + 1).tolist(), len(line)]
    return [line[start : stop + 1] for start, stop in itertools.pairwise(cuts)]


def _finite(lines: Mapping[str, Sequence[ArrayLike]]) -> dict[str, list[Array]]:
    """Return the lines [T, 2] without the rows that are not finite."""
    driven = {}
    for label, of_driver in lines.items():
        arrays = [np.asarray(line, dtype=np.float64).reshape(-1, 2) for line in of_driver]
        driven[label] = [array[np.isfinite(array).all(axis=1)] for array in arrays]
    return driven
