"""A picture of where on the tracks an agent listens to each of its guides."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.patheffects import Normal, Stroke
from numpy.typing import ArrayLike

from coil_rl.report import style
from coil_rl.report.scene import Scene

if TYPE_CHECKING:
    from coil_rl.envs.track import Track

# From next to nothing on asphalt to the strongest; it stays readable without colours, and is none of the cones'.
COLOURS = ListedColormap(mpl.colormaps["magma_r"](np.linspace(0.02, 0.88, 256)))
BAR = (2.2, 0.11)  # inches, as the next
BAR_ABOVE = 0.13
BAR_END = 0.34
LINE = 4.0  # points
RIM = 5.2  # points


def draw_listening_map(
    tracks: Sequence[Track],
    lines: Sequence[ArrayLike],
    values: Mapping[str, Sequence[ArrayLike]],
    path: str | os.PathLike[str],
    *,
    label: str,
    title: str | None = None,
) -> None:
    """Draw the driven line once for each guide, coloured by a measure; the colours mean the same everywhere.

    Args:
        tracks: at least one, N of them.
        lines: N driven lines, [T, 2] m each, at least one point.
        values: from guide to a value for each point of each line, N times [T]; not finite is left out.
        path: the picture, in the format of its ending (.png, .svg, .pdf), 8 inches wide.
        label: of the colour bar: the measure and its unit.
        title: above the picture.

    Raises:
        ValueError: if there is no guide, or if lines or values do not match the tracks.
    """
    if not values:
        raise ValueError("A listening map needs the values of at least one guide, none were given.")
    driven = [np.asarray(line, dtype=np.float64) for line in lines]
    measured = {guide: [np.asarray(row, dtype=np.float64) for row in rows] for guide, rows in values.items()}
    for guide, rows in measured.items():
        if [row.shape for row in rows] != [line.shape[:1] for line in driven] or len(driven) != len(tracks):
            raise ValueError(
                f"The values of {guide!r} have the shapes {[row.shape for row in rows]} for lines of "
                f"{[line.shape for line in driven]} on {len(tracks)} tracks; give one value a point, one line a track."
            )
    everything = np.concatenate([row for rows in measured.values() for row in rows])
    highest = float(np.nanmax([0.0, *everything])) or 1.0
    colours = ScalarMappable(Normalize(0, highest), COLOURS)

    panels = [(guide, index) for guide in measured for index in range(len(tracks))]
    stages = [replace(tracks[index], name=f"{guide}: {tracks[index].name}") for guide, index in panels]
    scene = Scene(stages, title=title, dpi=style.RESOLUTION, groups=len(measured))
    for stage, (guide, index) in enumerate(panels):
        at = driven[index] + scene.offsets[stage]
        middles = np.stack([at[:-1], at[1:]], axis=1)
        finite = np.isfinite(measured[guide][index][:-1])
        pieces = LineCollection(
            list(middles[finite]), array=measured[guide][index][:-1][finite], cmap=COLOURS, norm=colours.norm,
            lw=LINE, capstyle="round", zorder=4, path_effects=[Stroke(linewidth=RIM, foreground=style.PAPER), Normal()],
        )  # fmt: skip
        scene.axes.add_collection(pieces)
    with mpl.rc_context(style.LETTERS):
        width, height = scene.figure.get_size_inches()
        left = width - style.MARGIN - BAR_END - BAR[0]
        axes = scene.figure.add_axes((left / width, BAR_ABOVE / height, BAR[0] / width, BAR[1] / height))
        bar = scene.figure.colorbar(colours, cax=axes, orientation="horizontal")
        bar.outline.set_visible(False)
        bar.set_ticks([])
        middle = (BAR_ABOVE + BAR[1] / 2) / height
        scene.figure.text((left - 0.07) / width, middle, f"{label}  0", size=8, ha="right", va="center")
        axes.text(1.03, 0.5, f"{highest:.2g}", size=8, va="center", transform=axes.transAxes)
    scene.save(path)
