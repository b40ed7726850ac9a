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
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal
from matplotlib.patheffects import Stroke as StrokeEffect
from numpy.typing import ArrayLike
from PIL import Image

from coil_rl.cones.track_plot import Array, TrackPlot
from coil_rl.files import whole_file
from coil_rl.output import progress
from coil_rl.report import style

if TYPE_CHECKING:
    from coil_rl.envs.track import Track

GIF_RESOLUTION = 100  # dpi
TAIL = 0.6  # seconds of the animation, the line behind a car
FPS = 10  # GIFs count in hundredths of a second: 10, 20, 25 and 50 are exact; a frame takes 8 ms
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
    """Draw the lines of several policies on several tracks, all at one scale.

    Args:
        tracks: N of them, at least one.
        lines: N lines per policy, each [T, 2] m, x right and y up; T may be 0, rows that are not
            finite are left out. Policies whose name starts with "guide" are drawn in grey dashes;
            the last policy is on top.
        path: output file, 8 inches wide.
        crashed: per policy, whether each of the N lines ended in a crash; a cross marks it.
    """
    driven, ended = _finite(lines), crashed or {}
    strokes = style.strokes(driven)
    handles = style.handles(strokes, lw=1.8)
    plot = TrackPlot(tracks, legend=[*handles, *_crash_handle(ended)])
    for z, (label, stroke) in enumerate(strokes.items()):
        line_style = {"color": stroke.colour, "ls": stroke.linestyle}
        for index, (track, line) in enumerate(zip(tracks, driven[label], strict=True)):
            for lap in _split_laps(line, track):
                xy = (lap + plot.offsets[index]).T
                plot.axes.plot(*xy, lw=1.4, zorder=4 + z / 100, **line_style)
            if label in ended and ended[label][index] and len(line):
                xy = line[-1] + plot.offsets[index]
                plot.axes.plot(*xy, mfc=stroke.colour, zorder=5 + z / 100, **CRASH)
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
    """Write a GIF in which all policies drive on all tracks at the same time; it repeats.

    Args:
        tracks: N of them, at least one.
        lines: N lines per policy, see `draw_lines`.
        path: output file, 800 px wide.
        rate: steps of the lines per second.
        crashed: per policy, whether each of the N lines ended in a crash; a cross marks it.
        seconds: maximum duration; lines are never shown slower than they were driven.
    """
    driven, ended = _finite(lines), crashed or {}
    strokes = style.strokes(driven)
    handles = [
        Line2D([], [], mfc=stroke.colour, label=label, **CAR) for label, stroke in strokes.items()
    ]
    plot = TrackPlot(tracks, legend=[*handles, *_crash_handle(ended)], dpi=GIF_RESOLUTION)
    cars = []
    for (label, stroke), index in itertools.product(strokes.items(), range(len(tracks))):
        line = driven[label][index] + plot.offsets[index]
        crashes = label in ended and ended[label][index]
        cars.append(_Car(plot.axes, line, crashes, stroke.colour))
    duration = (max([1, *(len(car.line) for car in cars)]) - 1) / rate
    speed = max(1.0, duration / seconds)
    times = np.linspace(0, duration, 1 + math.ceil(duration / speed * FPS)).tolist()
    images = _frames(plot, cars, times, rate, speed)
    # The legend of the first frame has the colours of all policies.
    first = next(images).quantize(method=Image.Quantize.FASTOCTREE)
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


class _Car:
    """A car of the animation: a dot with a short line behind it.

    Args:
        axes: of the tracks.
        line: [T, 2], the driven line in coordinates of the axes.
        crashes: whether the line ends in a crash.
        colour: of dot and line.
    """

    def __init__(self, axes: Axes, line: Array, crashes: bool, colour: str) -> None:
        self.axes, self.line, self.crashes = axes, line, crashes
        (self.tail,) = axes.plot([], [], color=colour, lw=2.4, alpha=0.6)
        (self.head,) = axes.plot([], [], mfc=colour, **CAR)

    def draw(self, now: int, start: int) -> None:
        """Draw the car at a step, with its line since another step; both may be out of range."""
        now = min(now, len(self.line) - 1)
        self.tail.set_data(*self.line[max(0, start) : now + 1].T)
        self.head.set_data(*self.line[max(0, now) : now + 1].T)
        if self.crashes and now == len(self.line) - 1:
            self.head.set(marker=CRASH["marker"], markersize=CRASH["ms"])
        self.axes.draw_artist(self.tail)
        self.axes.draw_artist(self.head)


def _frames(
    plot: TrackPlot, cars: Sequence[_Car], times: Sequence[float], rate: float, speed: float
) -> Iterator[Image.Image]:
    """Yield a frame for each time, in seconds of the drive, with a clock.

    Args:
        rate: steps of the lines per second.
        speed: seconds of the drive in one of the animation.
    """
    figure, canvas = plot.figure, plot.canvas
    with mpl.rc_context(style.LETTERS):
        right, bottom = 1 - style.MARGIN / style.WIDTH, 14 / figure.bbox.height
        clock = figure.text(right, bottom, "", size=8, ha="right", va="center")
        canvas.draw()
    # Drawing the tracks in every frame would take three times as long.
    background = canvas.copy_from_bbox(figure.bbox)
    faster = f" ({speed:.0f}× speed)" if speed >= 1.5 else ""
    for time in progress(iterable=times, desc="animation", unit="frame", leave=False, disable=None):
        canvas.restore_region(background)
        now, start = round(time * rate), round((time - TAIL * speed) * rate)
        for car in cars:
            car.draw(now, start)
        clock.set_text(f"{time:.1f} s{faster}")
        figure.draw_artist(clock)
        yield Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


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
        label: of the colour bar, measure and unit.
        title: above the map.
    """
    every_value = np.concatenate(list(itertools.chain.from_iterable(values.values())))
    highest = float(np.nanmax([0.0, *every_value])) or 1.0
    colours = ScalarMappable(Normalize(0, highest), MEASURE_COLOURS)
    panels = list(itertools.product(values, range(len(tracks))))
    titled = [
        replace(tracks[index], name=f"{guide}: {tracks[index].name}") for guide, index in panels
    ]
    plot = TrackPlot(titled, title=title, groups=len(values))
    for panel, (guide, index) in enumerate(panels):
        xy = np.asarray(lines[index], dtype=np.float64) + plot.offsets[panel]
        plot.axes.add_collection(_coloured_line(xy, values[guide][index], colours))
    with mpl.rc_context(style.LETTERS):
        _draw_colour_bar(plot.figure, colours, label, highest)
    style.save(plot.figure, path)


def _coloured_line(xy: Array, values: ArrayLike, colours: ScalarMappable) -> LineCollection:
    """Return a line [T, 2] in the colours of its values [T]; the parts with NaN are left out."""
    segments = np.stack([xy[:-1], xy[1:]], axis=1)
    segment_values = np.asarray(values, dtype=np.float64)[:-1]
    finite = np.isfinite(segment_values)
    rim = [StrokeEffect(linewidth=5.2, foreground=style.BACKGROUND), Normal()]
    return LineCollection(
        list(segments[finite]),
        array=segment_values[finite],
        cmap=MEASURE_COLOURS,
        norm=colours.norm,
        lw=4.0,
        capstyle="round",
        zorder=4,
        path_effects=rim,
    )


def _draw_colour_bar(figure: Figure, colours: ScalarMappable, label: str, highest: float) -> None:
    """Draw a colour bar from 0 to `highest` in the lower right corner of a figure."""
    width, height = figure.get_size_inches()
    left, bottom, bar_width, bar_height = width - style.MARGIN - 0.34 - 2.2, 0.13, 2.2, 0.11
    axes = figure.add_axes((left / width, bottom / height, bar_width / width, bar_height / height))
    bar = figure.colorbar(colours, cax=axes, orientation="horizontal")
    bar.outline.set_visible(False)
    bar.set_ticks([])
    middle = (bottom + bar_height / 2) / height
    figure.text((left - 0.07) / width, middle, f"{label}  0", size=8, ha="right", va="center")
    axes.text(1.03, 0.5, f"{highest:.2g}", size=8, va="center", transform=axes.transAxes)


def _crash_handle(ended: Mapping[str, Sequence[bool]]) -> list[Line2D]:
    """Return the handle for the cross in the legend; none without a crash."""
    if not any(any(crashes) for crashes in ended.values()):
        return []
    cross: Any = {"ls": "", "marker": "X", "ms": 7, "mfc": style.INK, "mec": style.BACKGROUND}
    return [Line2D([], [], label="crash", **cross)]


def _split_laps(line: Array, track: Track) -> list[Array]:
    """Split a line where it crosses the finish line forwards.

    So the dashes of all laps coincide.
    """
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
