"""Map of several tracks at one scale, with track names, legend and scale bar."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from coil_rl.report import style
from coil_rl.report.statistics import Array

if TYPE_CHECKING:
    from coil_rl.envs.track import Track

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
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        *,
        legend: Sequence[Line2D] = (),
        title: str | None = None,
        dpi: int = style.RESOLUTION,
        groups: int = 1,
    ) -> None:
        with mpl.rc_context(style.LETTERS):
            self.figure = Figure(dpi=dpi)
            self.canvas = FigureCanvasAgg(self.figure)
            edges = [
                np.vstack([track.boundary("left", 0.25), track.boundary("right", 0.25)])
                for track in tracks
            ]
            lows = np.array([edge.min(axis=0) for edge in edges]) - 2 * CONE_RADIUS
            sizes = np.array([edge.max(axis=0) for edge in edges]) + 2 * CONE_RADIUS - lows
            grouped = np.arange(len(tracks)).reshape(groups, -1)
            rows = [
                row
                for group in grouped
                for row in np.array_split(group, -(-len(group) // TRACKS_PER_ROW))
            ]
            widths = [style.WIDTH - 2 * style.MARGIN - (len(row) - 1) * GAP for row in rows]
            fits = [width / sizes[row, 0].sum() for width, row in zip(widths, rows, strict=True)]
            self.scale = float(min(*fits, MAX_TRACK_HEIGHT / sizes[:, 1].max()))  # inches per metre
            self.figure.set_size_inches(style.WIDTH, 3.0)
            cone: dict[str, Any] = {
                "ls": "",
                "marker": "o",
                "ms": 4.5,
                "mec": style.INK,
                "mew": 0.4,
            }
            colours = {"left cones": style.LEFT_CONE, "right cones": style.RIGHT_CONE}
            cones = [
                Line2D([], [], mfc=colour, label=label, **cone) for label, colour in colours.items()
            ]
            header = style.draw_header(self.figure, [*legend, *cones], title) + 0.12
            heights = [NAME_HEIGHT + self.scale * float(sizes[row, 1].max()) for row in rows]
            height = header + sum(heights) + GAP * (len(rows) - 1) + 0.34
            height = round(height * dpi) / dpi  # whole pixels, for video players and GIF readers
            self.figure.set_size_inches(style.WIDTH, height)
            xlim, ylim = (0, style.WIDTH / self.scale), (0, height / self.scale)
            self.axes = self.figure.add_axes((0, 0, 1, 1), xlim=xlim, ylim=ylim)
            self.axes.axis("off")
            self.offsets = np.empty(
                (len(tracks), 2)
            )  # m, from the coordinates of each track to those of the axes
            top = header
            for row, row_height in zip(rows, heights, strict=True):
                free = (style.WIDTH - 2 * style.MARGIN - self.scale * sizes[row, 0].sum()) / len(
                    row
                )
                left = style.MARGIN + free / 2
                for index in row:
                    width, track_height = self.scale * sizes[index]
                    self.offsets[index] = (
                        self._metres(left, top + NAME_HEIGHT + track_height) - lows[index]
                    )
                    x, y = self._metres(left + width / 2, top + 0.04)
                    self.axes.text(
                        x, y, tracks[index].name, ha="center", va="top", color=style.QUIET
                    )
                    _draw_track(self.axes, tracks[index], self.offsets[index], self.scale)
                    left += width + free
                top += row_height + GAP
            x, y = self._metres(style.MARGIN, height - 0.14)
            bar = 10 if 10 * self.scale <= style.WIDTH / 2 else 1  # m
            ends = np.array([0.04, 0, 0, 0.04]) / self.scale
            self.axes.plot([x, x, x + bar, x + bar], ends + y, color=style.INK, lw=1)
            self.axes.text(x + bar + 0.07 / self.scale, y, f"{bar} m", size=8, va="center")

    def _metres(self, right: float, down: float) -> Array:
        """Convert inches from the upper left corner to coordinates of the axes."""
        return np.array([right, self.figure.get_size_inches()[1] - down]) / self.scale


def _draw_track(axes: Axes, track: Track, offset: Array, scale: float) -> None:
    # The opposite direction of the second ring makes the inner one a hole.
    rings = track.boundary("left", 0.1) + offset, track.boundary("right", 0.1)[::-1] + offset
    surface = Outline.make_compound_path(
        *(Outline(np.vstack([ring, ring[:1]]), closed=True) for ring in rings)
    )
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
