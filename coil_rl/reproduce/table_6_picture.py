"""The picture beside Tables 6 and 7: a panel for each driver, with the lines of all its drives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from coil_rl.envs.robot.course import THICK, THIN
from coil_rl.report import style
from coil_rl.report.style import picture
from coil_rl.reproduce.table_6_measures import Drive

COLUMNS = 2
PANEL = 2.5  # inches
HEADER = 0.7


def draw_drives(drives: Sequence[Drive], path: Path, title: str) -> None:
    """Draw each driver's lines between the cones, as far as it is known where they stood.

    Args:
        drives: at least one.
        path: the picture.
        title: above it.
    """
    methods = list(dict.fromkeys(drive.method for drive in drives))
    strokes = style.strokes(methods)
    rows = -(-len(methods) // COLUMNS)
    handles: list[Artist] = []
    if any(drive.track is not None for drive in drives):
        sides = (("thin cones", style.LEFT_CONE), ("thick cones", style.RIGHT_CONE))
        handles += [_dot(colour, "o", label) for label, colour in sides]
    if any(drive.row["crashed"] for drive in drives):
        handles.append(_dot(style.INK, "X", "crash"))
    with picture(path, title, handles, HEADER + rows * PANEL) as figure:
        panels = list(figure.subplots(rows, COLUMNS, squeeze=False).flat)
        for axes, method in zip(panels, methods, strict=False):
            of_method = [drive for drive in drives if drive.method == method]
            _draw_panel(axes, of_method, strokes[method].colour)
        for axes in panels[len(methods) :]:
            axes.axis("off")


def _draw_panel(axes: Axes, drives: Sequence[Drive], colour: str) -> None:
    count = f"{len(drives)} drives" if len(drives) > 1 else "one drive"
    axes.set_title(f"{drives[0].method}, {count} (m)", size=9, color=style.QUIET)
    axes.set_aspect("equal")
    axes.spines[["top", "right", "left", "bottom"]].set_visible(False)
    axes.tick_params(length=0, labelsize=7)
    axes.grid(color=style.ASPHALT, lw=0.5)
    axes.set_axisbelow(True)
    for track in {id(drive.track): drive.track for drive in drives if drive.track is not None}.values():
        for ring, radius, fill in ((track.left, THIN, style.LEFT_CONE), (track.right, THICK, style.RIGHT_CONE)):
            discs = [Circle((x, y), radius) for x, y in ring.tolist()]
            axes.add_collection(PatchCollection(discs, fc=fill, ec=style.INK, lw=0.3, zorder=3))
    for drive in drives:
        axes.plot(*drive.line.T, color=colour, lw=0.8, alpha=0.6, zorder=4)
        if drive.row["crashed"]:
            axes.plot(*drive.line[-1], "X", ms=7, mfc=colour, mec=style.BACKGROUND, mew=0.8, zorder=5)


def _dot(colour: str, marker: str, label: str) -> Line2D:
    return Line2D([], [], ls="", marker=marker, ms=5, mfc=colour, mec=style.INK, mew=0.4, label=label)
