"""What every picture looks like: its colours (safe for colour-blind readers), its letters and its width."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.transforms import BboxTransformTo, ScaledTranslation

WIDTH = 8.0  # inches; at 100 dpi as wide as a README shows a picture
MARGIN = 0.18  # inches, as the next two
TOP = 0.11
TITLE_HEIGHT = 0.26
RESOLUTION = 200  # dpi of still pictures, sharp on screens of double density too
SCREEN_RESOLUTION = 100  # dpi of moving pictures

INK = "#24292f"
QUIET = "#6e7781"
PAPER = "#ffffff"
ASPHALT = "#dfe2e6"
KERB = "#aeb4bb"
LEFT_CONE = "#f2b701"
RIGHT_CONE = "#1f6fd6"

# After Okabe and Ito and after Tol, without the colours of the cones, the strongest first.
AGENTS = ("#d55e00", "#009e73", "#aa3377", "#56b4e9", "#332288")
GUIDES = ("#4d4d4d", "#8a8a8a")
DASHES = (3.2, 1.6)
SECOND_ROUND = (6.0, 1.2)

LETTERS: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "text.parse_math": False,
    "axes.labelcolor": INK,
    "axes.edgecolor": KERB,
    "xtick.color": KERB,
    "ytick.color": KERB,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "figure.facecolor": PAPER,
}


@dataclass(frozen=True)
class Stroke:
    """How the line of one driver or method is drawn: colour, and lengths of dash and gap in line widths, if any."""

    colour: str
    dash: tuple[float, float] | None = None

    @property
    def linestyle(self) -> str | tuple[float, tuple[float, float]]:
        """Matplotlib's name for it."""
        return "-" if self.dash is None else (0.0, self.dash)


def strokes(labels: Iterable[str]) -> dict[str, Stroke]:
    """One stroke a driver: grey dashes if its name starts with "guide", the next strong colour otherwise."""
    labels = list(labels)
    guides = [label for label in labels if label.lower().startswith("guide")]
    greys = {label: Stroke(GUIDES[place % len(GUIDES)], DASHES) for place, label in enumerate(guides)}
    strong = strong_strokes(label for label in labels if label not in greys)
    return {label: greys.get(label) or strong[label] for label in labels}


def strong_strokes(labels: Iterable[str]) -> dict[str, Stroke]:
    """One stroke a label: a strong colour each, dashed from the second round of colours on."""
    return {
        label: Stroke(AGENTS[place % len(AGENTS)], SECOND_ROUND if place >= len(AGENTS) else None)
        for place, label in enumerate(labels)
    }


def draw_header(figure: Figure, handles: Sequence[Artist], title: str | None) -> float:
    """Write the title and, below it, a legend of as few lines as fit the width; both keep to the upper left corner.

    Returns:
        The height of the header in inches, whatever the figure's own height is or becomes.
    """
    corner = figure.dpi_scale_trans + ScaledTranslation(0, 1, BboxTransformTo(figure.bbox))
    height = TOP
    if title:
        figure.text(MARGIN, -height, title, size=11, weight="bold", va="top", transform=corner, in_layout=False)
        height += TITLE_HEIGHT
    for columns in range(len(handles), 0, -1):
        legend = figure.legend(
            handles=handles, ncols=columns, loc="upper left", bbox_to_anchor=(MARGIN, -height), bbox_transform=corner,
            frameon=False, borderaxespad=0, borderpad=0, handlelength=1.9, handletextpad=0.5, columnspacing=1.4,
        )  # fmt: skip
        extent = legend.get_window_extent()
        if extent.width <= (WIDTH - 2 * MARGIN) * figure.dpi or columns == 1:
            legend.set_in_layout(False)
            height += extent.height / figure.dpi
            break
        legend.remove()
    return height
