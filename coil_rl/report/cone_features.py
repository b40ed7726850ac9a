"""A picture of what the cone classifier has to tell apart (figure 25 of the paper)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from coil_rl.files import whole_file
from coil_rl.report import style

Array = NDArray[np.float64]

HEIGHT = 4.4  # inches
DOT, RING = 3.6, 7.0  # points across
ARROW = 2.2  # of an axis along one feature, in standard deviations


def principal_components(features: ArrayLike) -> tuple[Array, Array, Array]:
    """The two directions in which standardised features differ most.

    Args:
        features: [N, F], in any units.

    Returns:
        Each row's place on the two, [N, 2]; the two directions in standardised features, [F, 2], each with its largest
        part above 0; and the share of the variance along each, [2].

    Raises:
        ValueError: for fewer than two rows or features, numbers that are not finite or a feature that never changes.
    """
    given = np.asarray(features, dtype=np.float64)
    if given.ndim != 2 or min(given.shape) < 2:
        raise ValueError(f"features {list(given.shape)} must be [N, F], at least two rows of two features")
    spread = given.std(axis=0)
    if not (np.isfinite(given).all() and (spread > 0).all()):
        raise ValueError("features must be finite, and none of them the same in all rows")
    standard = (given - given.mean(axis=0)) / spread
    _, size, directions = np.linalg.svd(standard, full_matrices=False)
    axes = directions[:2].T
    axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), [0, 1]])
    return standard @ axes, axes, (size**2 / (size**2).sum())[:2]


def draw_cone_features(
    features: ArrayLike,
    thick: ArrayLike,
    path: str | os.PathLike[str],
    *,
    wrong: ArrayLike | None = None,
    names: Sequence[str] = ("width", "depth", "girth"),
    title: str | None = None,
) -> None:
    """Draw clusters of LiDAR points by the two principal components of their features.

    Args:
        features: [N, F], see `coil_rl.envs.robot.clusters`.
        thick: [N], which clusters are of thick cones.
        path: the picture, in the format of its ending, 8 inches wide.
        wrong: [N], which clusters the classifier takes for the other kind; they get a ring.
        names: [F], of the features; an arrow for each shows where it grows.
        title: above the picture; say "simulated" in it where the scans are.

    Raises:
        ValueError: as `principal_components`, and for numbers of rows or names that do not fit.
    """
    place, axes, share = principal_components(features)
    kind = np.asarray(thick, dtype=bool)
    ringed = np.zeros(len(place), dtype=bool) if wrong is None else np.asarray(wrong, dtype=bool)
    if kind.shape != place.shape[:1] or ringed.shape != place.shape[:1] or len(names) != len(axes):
        given = f"{list(kind.shape)}, {list(ringed.shape)} and {len(names)} names"
        raise ValueError(f"thick, wrong and names are {given} for {len(place)} clusters of {len(axes)} features")
    with mpl.rc_context(style.LETTERS):
        figure = Figure(figsize=(style.WIDTH, HEIGHT), dpi=style.RESOLUTION)
        FigureCanvasAgg(figure)
        header = style.draw_header(figure, _handles(kind, ringed), title)
        figure.set_layout_engine("constrained", rect=(0, 0, 1, 1 - header / HEIGHT), w_pad=style.MARGIN / 2, h_pad=0.1)
        labels = [f"{name} principal component ({100 * part:.0f} % of the variance)"
                  for name, part in zip(("first", "second"), share, strict=True)]  # fmt: skip
        panel = figure.add_subplot(xlabel=labels[0], ylabel=labels[1])
        panel.spines[["top", "right"]].set_visible(False)
        for of_kind, colour, marker in ((~kind, style.LEFT_CONE, "o"), (kind, style.RIGHT_CONE, "s")):
            panel.plot(*place[of_kind].T, marker, color=colour, ms=DOT, mec=style.PAPER, mew=0.3, alpha=0.75)
        panel.plot(*place[ringed].T, "o", ms=RING, mfc="none", mec=style.INK, mew=0.9)
        low, high = place.min(axis=0), place.max(axis=0)
        # Where few clusters are: the arrows begin in the corner at the upper right.
        x, y = high[0] - ARROW, high[1] - ARROW / 2
        for name, (right, up) in zip(names, axes, strict=True):
            tip = (x + ARROW / 2 * right, y + ARROW / 2 * up)
            panel.annotate("", tip, (x, y), arrowprops={"arrowstyle": "->", "color": style.QUIET, "lw": 1.2})
            beyond = (3 * np.sign(right), 3 * np.sign(up))
            panel.annotate(name, tip, beyond, textcoords="offset points", color=style.QUIET, size=8)
        panel.set_xlim(low[0] - 0.2, high[0] + 0.4)
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")


def _handles(thick: NDArray[np.bool_], wrong: NDArray[np.bool_]) -> list[Artist]:
    kinds = (("thin (left)", style.LEFT_CONE, "o", ~thick), ("thick (right)", style.RIGHT_CONE, "s", thick))
    handles: list[Artist] = [
        Line2D([], [], ls="", marker=marker, color=colour, ms=5, label=f"{name}, {int(of.sum())} clusters")
        for name, colour, marker, of in kinds
    ]
    if wrong.any():
        label = f"taken for the other kind, {int(wrong.sum())}"
        handles.append(Line2D([], [], ls="", marker="o", mfc="none", mec=style.INK, ms=6.5, label=label))
    return handles
