"""Features of LiDAR clusters of thin and thick cones, projected on two principal components (figure 25)."""

from __future__ import annotations

import os

import numpy as np
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from coil_rl.report import style

Array = NDArray[np.float64]

FEATURES = ("width", "depth", "girth")
ARROW_LENGTH = 2.2  # of a standard deviation of a feature, on the axes of the plot


def principal_components(features: ArrayLike) -> tuple[Array, Array, Array]:
    """Return the first two principal components of standardised features [N, F], none of them constant.

    Returns:
        Coordinates of the rows, [N, 2]; directions in standardised features, [F, 2], each with its largest component
        above 0; and the shares of the variance, [2].
    """
    from sklearn.decomposition import PCA  # takes seconds to import
    from sklearn.preprocessing import StandardScaler

    pca = PCA(2, svd_solver="full")
    coordinates = pca.fit_transform(StandardScaler().fit_transform(np.asarray(features, dtype=np.float64)))
    signs = np.sign(pca.components_[[0, 1], np.abs(pca.components_).argmax(axis=1)])
    return coordinates * signs, pca.components_.T * signs, pca.explained_variance_ratio_


def draw_cone_features(
    features: ArrayLike,
    thick: ArrayLike,
    path: str | os.PathLike[str],
    *,
    wrong: ArrayLike | None = None,
    title: str | None = None,
) -> None:
    """Draw clusters of LiDAR points by the two principal components of their features.

    Args:
        features: [N, 3], see `coil_rl.envs.robot.clusters`; an arrow shows the direction in which each grows.
        thick: [N], whether the cluster is a thick cone.
        path: output file.
        wrong: [N], whether the cluster is misclassified; it gets a ring.
        title: above the plot; it should contain "simulated" for simulated scans.
    """
    xy, directions, share = principal_components(features)
    is_thick = np.asarray(thick, dtype=bool)
    is_wrong = np.zeros(len(xy), dtype=bool) if wrong is None else np.asarray(wrong, dtype=bool)
    kinds = (("thin (left)", ~is_thick, style.LEFT_CONE, "o"), ("thick (right)", is_thick, style.RIGHT_CONE, "s"))
    handles: list[Artist] = [
        Line2D([], [], ls="", marker=marker, color=colour, ms=5, label=f"{name}, {int(rows.sum())} clusters")
        for name, rows, colour, marker in kinds
    ]
    if is_wrong.any():
        label = f"misclassified, {int(is_wrong.sum())}"
        handles.append(Line2D([], [], ls="", marker="o", mfc="none", mec=style.INK, ms=6.5, label=label))
    with style.picture(path, title, handles, 4.4) as figure:
        first, second = (f"principal component ({100 * part:.0f} % of the variance)" for part in share)
        axes = figure.add_subplot(xlabel=f"first {first}", ylabel=f"second {second}")
        axes.spines[["top", "right"]].set_visible(False)
        for _, rows, colour, marker in kinds:
            axes.plot(*xy[rows].T, marker, color=colour, ms=3.6, mec=style.BACKGROUND, mew=0.3, alpha=0.75)
        axes.plot(*xy[is_wrong].T, "o", ms=7.0, mfc="none", mec=style.INK, mew=0.9)
        low, high = xy.min(axis=0), xy.max(axis=0)
        # The upper right corner has few clusters.
        start = (high[0] - ARROW_LENGTH, high[1] - ARROW_LENGTH / 2)
        for name, direction in zip(FEATURES, directions, strict=True):
            tip = start + ARROW_LENGTH / 2 * direction
            axes.annotate("", tip, start, arrowprops={"arrowstyle": "->", "color": style.QUIET, "lw": 1.2})
            axes.annotate(name, tip, 3 * np.sign(direction), textcoords="offset points", color=style.QUIET, size=8)
        axes.set_xlim(low[0] - 0.2, high[0] + 0.4)
