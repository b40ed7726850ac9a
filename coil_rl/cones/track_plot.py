"""Map of several tracks at one scale, with track names, legend and scale bar."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from coil_rl.report import style
from coil_rl.report.statistics import Array

if TYPE_CHECKING:
    from coil_rl.envs.track import Track

Integers = NDArray[np.int64]

GAP = 0.22  # inches, as the next two
NAME_HEIGHT = 0.26
MAX_TRACK_HEIGHT = 4.6
TRACKS_PER_ROW = 3
CONE_RADIUS = 0.24  # m


class TrackPlot:
    """A figure, 8 inches wide, with all tracks in one set of axes, in metres.

    Args:
        tracks: at least one; up to three in a row.
        legend: handles for what is drawn on the tracks; those of the cones are added.
        title: above the legend.
        dpi: pixels per inch.
        groups: number of groups of equally many tracks; each group begins a row.

    Attributes:
        figure: the figure.
        canvas: of the figure.
        axes: the axes with all tracks, in metres.
        scale: inches per metre.
        offsets: [N, 2] m, from the coordinates of each of the N tracks to those of the axes.
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        *,
        legend: Sequence[Artist] = (),
        title: str | None = None,
        dpi: int = style.RESOLUTION,
        groups: int = 1,
    ) -> None:
        with mpl.rc_context(style.LETTERS):
            self.figure = Figure(dpi=dpi)
            self.canvas = FigureCanvasAgg(self.figure)
            self._measure(tracks, groups)
            self.figure.set_size_inches(style.WIDTH, 3.0)
            handles = [*legend, *_cone_handles()]
            header = style.draw_header(self.figure, handles, title) + 0.12
            height = header + sum(map(self._height, self._rows)) + GAP * (len(self._rows) - 1)
            # Whole pixels, for video players and GIF readers.
            height = round((height + 0.34) * dpi) / dpi
            self.figure.set_size_inches(style.WIDTH, height)
            xlim, ylim = (0, style.WIDTH / self.scale), (0, height / self.scale)
            self.axes = self.figure.add_axes((0, 0, 1, 1), xlim=xlim, ylim=ylim)
            self.axes.axis("off")
            self.offsets = np.empty((len(tracks), 2))
            top = header
            for row in self._rows:
                self._draw_row(tracks, row, top)
                top += self._height(row) + GAP
            self._draw_scale_bar()

    def _measure(self, tracks: Sequence[Track], groups: int) -> None:
        """Divide the tracks into rows, and choose the scale at which they fit."""
        edges = [
            np.vstack([track.boundary("left", 0.25), track.boundary("right", 0.25)])
            for track in tracks
        ]
        # Lower left corner and size of each track, [N, 2] m.
        self._lows = np.array([edge.min(axis=0) for edge in edges]) - 2 * CONE_RADIUS
        self._sizes = np.array([edge.max(axis=0) for edge in edges]) + 2 * CONE_RADIUS - self._lows
        self._rows: list[Integers] = []
        for group in np.arange(len(tracks)).reshape(groups, -1):
            self._rows += np.array_split(group, -(-len(group) // TRACKS_PER_ROW))
        self.scale = float(MAX_TRACK_HEIGHT / self._sizes[:, 1].max())
        for row in self._rows:
            width = style.WIDTH - 2 * style.MARGIN - (len(row) - 1) * GAP
            self.scale = min(self.scale, float(width / self._sizes[row, 0].sum()))

    def _height(self, row: Integers) -> float:
        """Return the height of a row of tracks with their names, in inches."""
        return NAME_HEIGHT + self.scale * float(self._sizes[row, 1].max())

    def _draw_row(self, tracks: Sequence[Track], row: Integers, top: float) -> None:
        """Draw the tracks with some indices side by side.

        Args:
            top: distance to the upper edge of the figure, inches.
        """
        used = self.scale * self._sizes[row, 0].sum()
        free = (style.WIDTH - 2 * style.MARGIN - used) / len(row)
        left = style.MARGIN + free / 2
        for index in row:
            width, height = self.scale * self._sizes[index]
            corner = self._metres(left, top + NAME_HEIGHT + height)
            self.offsets[index] = corner - self._lows[index]
            x, y = self._metres(left + width / 2, top + 0.04)
            self.axes.text(x, y, tracks[index].name, ha="center", va="top", color=style.QUIET)
            _draw_track(self.axes, tracks[index], self.offsets[index], self.scale)
            left += width + free

    def _draw_scale_bar(self) -> None:
        """Draw a bar of 10 m, or of 1 m if the tracks are small, in the lower left corner."""
        x, y = self._metres(style.MARGIN, self.figure.get_size_inches()[1] - 0.14)
        bar = 10 if 10 * self.scale <= style.WIDTH / 2 else 1  # m
        ends = np.array([0.04, 0, 0, 0.04]) / self.scale
        self.axes.plot([x, x, x + bar, x + bar], ends + y, color=style.INK, lw=1)
        self.axes.text(x + bar + 0.07 / self.scale, y, f"{bar} m", size=8, va="center")

    def _metres(self, right: float, down: float) -> Array:
        """Convert inches from the upper left corner to coordinates of the axes."""
        return np.array([right, self.figure.get_size_inches()[1] - down]) / self.scale


def _cone_handles() -> list[Line2D]:
    """Return the handles of the cones in the legend."""
    cone: dict[str, Any] = {"ls": "", "marker": "o", "ms": 4.5, "mec": style.INK, "mew": 0.4}
    colours = {"left cones": style.LEFT_CONE, "right cones": style.RIGHT_CONE}
    return [Line2D([], [], mfc=colour, label=label, **cone) for label, colour in colours.items()]


def _draw_track(axes: Axes, track: Track, offset: Array, scale: float) -> None:
    """Draw surface, finish line and cones of a track; the scale is in inches per metre."""
    # The opposite direction of the second ring makes the inner one a hole.
    rings = track.boundary("left", 0.1) + offset, track.boundary("right", 0.1)[::-1] + offset
    outlines = [Outline(np.vstack([ring, ring[:1]]), closed=True) for ring in rings]
    surface = Outline.make_compound_path(*outlines)
    axes.add_patch(PathPatch(surface, fc=style.ASPHALT, ec=style.KERB, lw=0.6, zorder=1))
    line = np.stack([track.left[0], track.right[0]]) + offset
    width = float(np.clip(0.35 * scale * 72, 2.4, 6.0))
    axes.plot(*line.T, color=style.INK, lw=width, solid_capstyle="butt", zorder=2)
    axes.plot(
        *line.T,
        color=style.BACKGROUND,
        lw=0.55 * width,
        ls=(0, (1.2, 1.2)),
        dash_capstyle="butt",
        zorder=2,
    )
    diameter = float(np.clip(2 * CONE_RADIUS * scale * 72, 2.4, 7.0))
    for cones, colour in ((track.left, style.LEFT_CONE), (track.right, style.RIGHT_CONE)):
        x, y = (cones + offset).T
        axes.scatter(
            x, y, s=diameter**2, color=colour, edgecolors=style.INK, linewidths=0.3, zorder=3
        )
