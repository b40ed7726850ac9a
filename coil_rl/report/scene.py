"""The stage of the driven lines: tracks side by side at one scale, with names, legend and a scale bar."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray

from coil_rl.files import whole_file
from coil_rl.report import style

if TYPE_CHECKING:
    from coil_rl.envs.track import Track

Array = NDArray[np.float64]

# In inches.
GAP = 0.22
NAME_HEIGHT = 0.26
HEADER_GAP = 0.12
FOOT_HEIGHT = 0.34
TALLEST = 4.6
MOST_IN_A_ROW = 3
SCALE_BARS = (10, 1)  # m; the first that takes at most half the width
CONE_RADIUS = 0.24  # m
FINISH_LINE = 0.35  # m


class Scene:
    """A figure with every track on one stage, in metres: one scale for all, so that one scale bar serves.

    Args:
        tracks: at least one; up to three stand in a row.
        legend: the handles that explain what will be drawn on the tracks; those of the tracks themselves are added.
        title: above everything.
        dpi: pixels per inch of the 8 inches.
        groups: of equally many tracks; each begins a row.
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        *,
        legend: Sequence[Line2D] = (),
        title: str | None = None,
        dpi: int,
        groups: int = 1,
    ) -> None:
        if not tracks:
            raise ValueError("A picture of driven lines needs at least one track, none was given.")
        with mpl.rc_context(style.LETTERS):
            self.figure = Figure(dpi=dpi)
            self.canvas = FigureCanvasAgg(self.figure)
            edges = [np.vstack([track.boundary("left", 0.25), track.boundary("right", 0.25)]) for track in tracks]
            lows = np.array([edge.min(axis=0) for edge in edges]) - 2 * CONE_RADIUS
            sizes = np.array([edge.max(axis=0) for edge in edges]) + 2 * CONE_RADIUS - lows
            grouped = np.arange(len(tracks)).reshape(groups, -1)
            rows = [row for group in grouped for row in np.array_split(group, -(-len(group) // MOST_IN_A_ROW))]
            room = [style.WIDTH - 2 * style.MARGIN - (len(row) - 1) * GAP for row in rows]
            fits = [width / sizes[row, 0].sum() for width, row in zip(room, rows, strict=True)]
            self.scale = float(min(*fits, TALLEST / sizes[:, 1].max()))
            """Inches per metre."""

            self.figure.set_size_inches(style.WIDTH, 3.0)
            header = style.draw_header(self.figure, [*legend, *_track_handles()], title) + HEADER_GAP
            heights = [NAME_HEIGHT + self.scale * float(sizes[row, 1].max()) for row in rows]
            height = header + sum(heights) + GAP * (len(rows) - 1) + FOOT_HEIGHT
            # Video players and GIF readers like whole pixels.
            self.figure.set_size_inches(style.WIDTH, round(height * dpi) / dpi)
            self.axes = self._stage()
            self.offsets = np.empty((len(tracks), 2))
            """[tracks, 2] m: what brings a track's coordinates to its place on the stage."""
            top = header
            for row, below in zip(rows, heights, strict=True):
                free = (style.WIDTH - 2 * style.MARGIN - self.scale * sizes[row, 0].sum()) / len(row)
                left = style.MARGIN + free / 2
                for index in row:
                    width, tall = self.scale * sizes[index]
                    self.offsets[index] = self._metres(left, top + NAME_HEIGHT + tall) - lows[index]
                    x, y = self._fraction(left + width / 2, top + 0.04)
                    self.figure.text(x, y, tracks[index].name, ha="center", va="top", color=style.QUIET)
                    _draw_track(self.axes, tracks[index], self.offsets[index], self.scale)
                    left += width + free
                top += below + GAP
            self._scale_bar()

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the figure in the format of the path's ending, or as PNG if it has none."""
        with whole_file(path) as unfinished, mpl.rc_context(style.LETTERS):
            self.figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")

    def image(self) -> NDArray[np.uint8]:
        """What is on the figure now, [H, W, 3]."""
        with mpl.rc_context(style.LETTERS):
            self.canvas.draw()
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()

    def pixels(self, index: int, points: Array) -> Array:
        """Where points [N, 2] m of track `index` lie on the image: [N, 2] px, from the upper left corner."""
        at: Array = self.axes.transData.transform((points + self.offsets[index]).reshape(-1, 2))
        at[:, 1] = self.figure.bbox.height - at[:, 1]
        return at

    def _fraction(self, right: float, down: float) -> tuple[float, float]:
        """Inches from the upper left corner as fractions of the figure from the lower left one."""
        width, height = self.figure.get_size_inches()
        return right / width, 1 - down / height

    def _metres(self, right: float, down: float) -> Array:
        """Inches from the upper left corner as a place on the stage."""
        return np.array([right, self.figure.get_size_inches()[1] - down]) / self.scale

    def _stage(self) -> Axes:
        width, height = self.figure.get_size_inches() / self.scale
        axes = self.figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, height))
        axes.axis("off")
        return axes

    def _scale_bar(self) -> None:
        height = float(self.figure.get_size_inches()[1])
        x, y = self._metres(style.MARGIN, height - 0.14)
        bar = next((bar for bar in SCALE_BARS if bar * self.scale <= style.WIDTH / 2), SCALE_BARS[-1])
        self.axes.plot([x, x, x + bar, x + bar], np.array([0.04, 0, 0, 0.04]) / self.scale + y, color=style.INK, lw=1)
        self.axes.text(x + bar + 0.07 / self.scale, y, f"{bar} m", size=8, va="center")


def _track_handles() -> list[Line2D]:
    def cone(colour: str, side: str) -> Line2D:
        return Line2D([], [], ls="", marker="o", ms=4.5, mfc=colour, mec=style.INK, mew=0.4, label=f"{side} cones")

    return [cone(style.LEFT_CONE, "left"), cone(style.RIGHT_CONE, "right")]


def _draw_track(axes: Axes, track: Track, offset: Array, scale: float) -> None:
    # Turning one ring around makes it a hole in the other, whichever is the inner one.
    rings = track.boundary("left", 0.1) + offset, track.boundary("right", 0.1)[::-1] + offset
    surface = Outline.make_compound_path(*(Outline(np.vstack([ring, ring[:1]]), closed=True) for ring in rings))
    axes.add_patch(PathPatch(surface, fc=style.ASPHALT, ec=style.KERB, lw=0.6, zorder=1))
    line = np.stack([track.left[0], track.right[0]]) + offset
    thick = float(np.clip(FINISH_LINE * scale * 72, 2.4, 6.0))
    axes.plot(*line.T, color=style.INK, lw=thick, solid_capstyle="butt", zorder=2)
    axes.plot(*line.T, color=style.PAPER, lw=0.55 * thick, ls=(0, (1.2, 1.2)), dash_capstyle="butt", zorder=2)
    diameter = float(np.clip(2 * CONE_RADIUS * scale * 72, 2.4, 7.0))
    for cones, colour in ((track.left, style.LEFT_CONE), (track.right, style.RIGHT_CONE)):
        x, y = (cones + offset).T
        axes.scatter(x, y, s=diameter**2, color=colour, edgecolors=style.INK, linewidths=0.3, zorder=3)
