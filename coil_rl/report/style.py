"""Shared style of all figures: colours safe for colour-blind readers, fonts, title, legend and output file."""

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import BboxTransformTo, ScaledTranslation

from coil_rl.files import whole_file

WIDTH = 8.0  # inches
MARGIN = 0.18  # inches
RESOLUTION = 200  # dpi

INK = "#24292f"
QUIET = "#6e7781"
BACKGROUND = "#ffffff"
ASPHALT = "#dfe2e6"
KERB = "#aeb4bb"
LEFT_CONE = "#f2b701"
RIGHT_CONE = "#1f6fd6"

# After Okabe and Ito and after Tol, without the colours of the cones, the strongest first.
AGENTS = ("#d55e00", "#009e73", "#aa3377", "#56b4e9", "#332288")
GUIDES = ("#4d4d4d", "#8a8a8a")
DASHED = (0.0, (3.2, 1.6))
SECOND_ROUND = (0.0, (6.0, 1.2))  # of a colour that is used again

LETTERS: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "text.parse_math": False,
    "figure.facecolor": BACKGROUND,
    "axes.labelcolor": INK,
    "axes.edgecolor": KERB,
}
LETTERS |= {
    f"{axis}tick.{key}": colour
    for axis in "xy"
    for key, colour in (("color", KERB), ("labelcolor", INK))
}


class Stroke(NamedTuple):
    """Colour and line style of one driver or method."""

    colour: str
    linestyle: Any = "-"


def strokes(labels: Iterable[str]) -> dict[str, Stroke]:
    """Return a stroke for each driver: grey dashes if its name starts with "guide", the next strong colour if not."""
    labels = list(labels)
    guides = [label for label in labels if label.lower().startswith("guide")]
    greys = {
        label: Stroke(GUIDES[index % len(GUIDES)], DASHED) for index, label in enumerate(guides)
    }
    strong = strong_strokes(label for label in labels if label not in greys)
    return {label: greys.get(label) or strong[label] for label in labels}


def strong_strokes(labels: Iterable[str]) -> dict[str, Stroke]:
    """Return a stroke in a strong colour for each label, dashed once the colours are used again."""
    return {
        label: Stroke(AGENTS[index % len(AGENTS)], SECOND_ROUND if index >= len(AGENTS) else "-")
        for index, label in enumerate(labels)
    }


@contextmanager
def picture(
    path: str | os.PathLike[str],
    title: str | None,
    handles: Sequence[Artist],
    height: float,
    *,
    add_header: bool = False,
    h_pad: float = 0.1,
) -> Iterator[Figure]:
    """Yield an empty figure with title and legend; write it when the block ends.

    It is 8 inches wide and `height` inches high, with `add_header` without title and legend. The
    suffix of the path decides the format. `h_pad` is the vertical padding of the layout in inches.
    """
    with mpl.rc_context(LETTERS):
        figure = Figure(figsize=(WIDTH, height), dpi=RESOLUTION)
        header = draw_header(figure, handles, title)
        if add_header:
            header += 0.06
            height += header
            figure.set_figheight(height)
        figure.set_layout_engine(
            "constrained", rect=(0, 0, 1, 1 - header / height), w_pad=MARGIN / 2, h_pad=h_pad
        )
        yield figure
        save(figure, path)


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure in the format of the path's suffix, PNG if it has none; the file appears whole or not at all."""
    with whole_file(path) as unfinished, mpl.rc_context(LETTERS):
        figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")


def lighten(axes: Axes, grid: str = "y") -> None:
    """Remove the upper and right spine and draw a faint grid along one axis."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y" if grid == "y" else "x", color=ASPHALT, lw=0.7)
    axes.set_axisbelow(True)


def draw_header(figure: Figure, handles: Sequence[Artist], title: str | None) -> float:
    """Draw title and legend, in as few lines as fit, in the upper left corner; return their height in inches."""
    corner = figure.dpi_scale_trans + ScaledTranslation(0, 1, BboxTransformTo(figure.bbox))
    height = 0.11
    if title:
        figure.text(
            MARGIN,
            -height,
            title,
            size=11,
            weight="bold",
            va="top",
            transform=corner,
            in_layout=False,
        )
        height += 0.26
    for columns in range(len(handles), 0, -1):
        legend = figure.legend(
            handles=handles,
            ncols=columns,
            loc="upper left",
            bbox_to_anchor=(MARGIN, -height),
            bbox_transform=corner,
            frameon=False,
            borderaxespad=0,
            borderpad=0,
            handlelength=1.9,
            handletextpad=0.5,
            columnspacing=1.4,
        )
        extent = legend.get_window_extent()
        if extent.width <= (WIDTH - 2 * MARGIN) * figure.dpi or columns == 1:
            legend.set_in_layout(False)
            height += extent.height / figure.dpi
            break
        legend.remove()
    return height
