"""Shared style of all figures: colours, fonts, title, legend and output file.

The colours are safe for colour-blind readers.
"""

import io
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
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
AGENTS = (
    *("#d55e00", "#009e73", "#aa3377", "#56b4e9", "#332288"),
    *("#8c510a", "#6b8e23", "#cc79a7", "#b8860b", "#7b68a6"),
)
GUIDES = ("#4d4d4d", "#8a8a8a")
DASHED = (0.0, (3.2, 1.6))
SECOND_ROUND = (0.0, (6.0, 1.2))  # of a colour that is used again
LATER_ROUNDS = (SECOND_ROUND, (0.0, (1.2, 1.2)), (0.0, (6.0, 1.2, 1.2, 1.2)))

Target = str | os.PathLike[str] | io.BytesIO  # a buffer receives an SVG

LETTERS: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "text.parse_math": False,
    "svg.fonttype": "none",  # text, which can be read, searched and copied
    "svg.hashsalt": "coil-rl",  # equal pictures are equal files
    "figure.facecolor": BACKGROUND,
    "axes.labelcolor": INK,
    "axes.edgecolor": KERB,
    "xtick.color": KERB,
    "xtick.labelcolor": INK,
    "ytick.color": KERB,
    "ytick.labelcolor": INK,
}


NO_METADATA: Any = dict.fromkeys(("Creator", "Date", "Format", "Type"))  # of an SVG


class Stroke(NamedTuple):
    """Colour and line style of one policy or method.

    Attributes:
        colour: as matplotlib takes it.
        linestyle: as matplotlib takes it; solid by default.
    """

    colour: str
    linestyle: Any = "-"


# Of the methods that are compared most often, so that they look the same in all pictures.
OWN = {
    "coil": Stroke(AGENTS[0]),
    "coil_anchored": Stroke(AGENTS[1]),
    "imitate_then_ppo": Stroke(AGENTS[2]),
    "ppo": Stroke(AGENTS[3]),
    "kickstart": Stroke(AGENTS[4]),
    "residual": Stroke(AGENTS[5]),
    "jump_start": Stroke(AGENTS[6]),
    "residual_coil": Stroke(AGENTS[7]),
    "tune": Stroke(AGENTS[8]),
    "sac": Stroke(AGENTS[9]),
    "coil_anchored_sac": Stroke(AGENTS[1], SECOND_ROUND),
}


def strokes(labels: Iterable[str]) -> dict[str, Stroke]:
    """Return a stroke for each policy.

    A policy whose name starts with "guide" gets grey dashes, another one the next strong colour.

    Args:
        labels: names of the policies, all different.
    """
    labels = list(labels)
    guides = [label for label in labels if label.lower().startswith("guide")]
    greys = {
        label: Stroke(grey, DASHED) for label, grey in zip(guides, cycle(GUIDES), strict=False)
    }
    strong = strong_strokes(label for label in labels if label not in greys)
    return {label: (greys | strong)[label] for label in labels}


def strong_strokes(labels: Iterable[str]) -> dict[str, Stroke]:
    """Return a stroke in a strong colour for each label, dashed once the colours are used again.

    The methods of `OWN` have their own, and so have the variants of a method, such as "ppo 2", of
    which further ones have other dashes. The others take what is left, in the given order.

    Args:
        labels: names of the policies or methods, all different.
    """
    labels = list(labels)
    result: dict[str, Stroke] = {}
    for label in labels:
        own = OWN.get(re.sub(r" \d+$", "", label))
        if own is not None:
            variants = [own, *(Stroke(own.colour, dashes) for dashes in LATER_ROUNDS)]
            free = [stroke for stroke in variants if stroke not in result.values()]
            result[label] = free[0] if free else own
    others = [label for label in labels if label not in result]
    result |= dict(zip(others, _free_strokes(list(result.values())), strict=False))
    return {label: result[label] for label in labels}


def _free_strokes(taken: Sequence[Stroke]) -> Iterator[Stroke]:
    """Yield strokes: first in unused colours, then in unused dashes, then used ones again."""
    colours = {stroke.colour for stroke in taken}
    yield from (Stroke(colour) for colour in AGENTS if colour not in colours)
    dashed = [Stroke(colour, dashes) for dashes in LATER_ROUNDS for colour in AGENTS]
    yield from (stroke for stroke in dashed if stroke not in taken)
    yield from cycle(dashed)


def handles(strokes: Mapping[str, Stroke], **options: Any) -> list[Artist]:
    """Return a line of the legend for each policy, by its label.

    Args:
        options: of matplotlib, for all lines.
    """
    return [
        Line2D([], [], color=stroke.colour, ls=stroke.linestyle, label=label, **options)
        for label, stroke in strokes.items()
    ]


def panels(figure: Figure, titles: Sequence[str], most: int, size: float = 9) -> list[Axes]:
    """Return a panel for each title, in rows of at most `most`, all with the same limits.

    Args:
        size: of the titles, points.
    """
    columns = min(most, len(titles))
    shape = (-(-len(titles) // columns), columns)
    grid = list(figure.subplots(*shape, sharex=True, sharey=True, squeeze=False).flat)
    for axes, title in zip(grid, titles, strict=False):
        axes.set_title(title, size=size, loc="left")
    for axes in grid[len(titles) :]:
        axes.remove()
    return grid[: len(titles)]


@contextmanager
def picture(
    path: Target,
    title: str | None,
    handles: Sequence[Artist],
    height: float,
    *,
    add_header: bool = False,
    h_pad: float = 0.1,
) -> Iterator[Figure]:
    """Yield an empty figure with title and legend, 8 inches wide; write it when the block ends.

    Args:
        path: output file, whose suffix decides the format; or a buffer for an SVG.
        title: above the legend; None for none.
        height: of the figure, inches.
        add_header: whether the height does not count title and legend.
        h_pad: vertical padding of the layout, inches.
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


def save(figure: Figure, path: Target) -> None:
    """Write a figure; the file appears whole or not at all.

    Args:
        path: output file, whose suffix decides the format, PNG without a suffix; or a buffer for an
            SVG.
    """
    if isinstance(path, io.BytesIO):
        with mpl.rc_context(LETTERS):
            figure.savefig(path, format="svg", metadata=NO_METADATA)
        return
    with whole_file(path) as unfinished, mpl.rc_context(LETTERS):
        figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")


def lighten(axes: Axes, grid: str = "y") -> None:
    """Remove the upper and right spine and draw a faint grid along one axis.

    Args:
        grid: "y" for horizontal lines, "x" for vertical ones.
    """
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y" if grid == "y" else "x", color=ASPHALT, lw=0.7)
    axes.set_axisbelow(True)


def draw_header(figure: Figure, handles: Sequence[Artist], title: str | None) -> float:
    """Draw title and legend in the upper left corner, in as few lines as fit.

    Args:
        figure: 8 inches wide.
        title: above the legend; None for none.

    Returns:
        The height of both, inches.
    """
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
