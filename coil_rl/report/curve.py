"""Learning curves: return against frames, for one run or for several seeds of several methods."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import SupportsFloat, cast

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from coil_rl.files import whole_file
from coil_rl.report import style

Array = NDArray[np.float64]
Run = Sequence[Mapping[str, object]]

TRAINING = "train/return"
EVALUATION = "evaluation/return"
RESAMPLES = 2000
HEIGHT = 4.2  # inches
UNITS = {1e6: "frames (millions)", 1e3: "frames (thousands)"}


def draw_learning_curves(
    runs: Mapping[str, Sequence[Run]],
    path: str | os.PathLike[str],
    *,
    guides: Mapping[str, float] | None = None,
    title: str | None = None,
) -> None:
    """Draw how the return grows with training: thin while training, with dots where the agent was evaluated.

    Several runs of one label are drawn as their mean, over the frames that all of them reached, with the 95 %
    bootstrap interval of that mean as a band.

    Args:
        runs: from label to its runs (seeds), each a sequence of rows with "frames" (frames of the env so far) and
            "train/return" or "evaluation/return" or both; a row may lack either, or have None or NaN for it.
        path: the picture, in the format of its ending, 8 inches wide.
        guides: from the name of each guide to its own mean return, drawn as a dashed line.
        title: above the picture.

    Raises:
        ValueError: if there is no run, or a row has no frames.

    Example:
        >>> rows = [{"frames": 1e5 * n, "train/return": 3.0 * n} for n in range(10)]
        >>> draw_learning_curves({"COIL": [rows]}, "curve.png", guides={"guide": 20.0})  # doctest: +SKIP
    """
    if not any(len(of_label) for of_label in runs.values()):
        raise ValueError(f"A learning curve needs at least one run; got none for: {', '.join(runs) or 'no label'}.")
    means = {
        label: {key: mean_curve(of_label, key) for key in (TRAINING, EVALUATION)} for label, of_label in runs.items()
    }
    reached = max(
        (frames[-1] for of_label in means.values() for frames, *_ in of_label.values() if len(frames)), default=0.0
    )
    size, unit = unit_of_frames(reached)
    strokes = style.strong_strokes(runs)
    with mpl.rc_context(style.LETTERS):
        figure = Figure(figsize=(style.WIDTH, HEIGHT), dpi=style.RESOLUTION)
        FigureCanvasAgg(figure)
        header = style.draw_header(figure, _handles(runs, strokes), title)
        figure.set_layout_engine("constrained", rect=(0, 0, 1, 1 - header / HEIGHT), w_pad=style.MARGIN / 2, h_pad=0.1)
        axes = figure.add_subplot(xlabel=unit, ylabel="return (sum of rewards of an episode)")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color=style.ASPHALT, lw=0.7)
        axes.set_axisbelow(True)
        for label, stroke in strokes.items():
            for key, (frames, mean, low, high) in means[label].items():
                thin = key == TRAINING
                axes.plot(
                    frames / size, mean, color=stroke.colour, ls=stroke.linestyle, alpha=0.45 if thin else 1,
                    lw=0.9 if thin else 2, marker="" if thin else "o", ms=4.5, mec=style.PAPER, mew=0.6,
                )  # fmt: skip
                if not thin or not len(means[label][EVALUATION][0]):
                    axes.fill_between(frames / size, low, high, color=stroke.colour, alpha=0.16, lw=0)
        axes.margins(x=0.02)
        axes.set_xlim(left=0)
        for (name, value), colour in zip((guides or {}).items(), cycle(style.GUIDES), strict=False):
            axes.axhline(value, color=colour, ls=(0, style.DASHES), lw=1.3, zorder=1.5)
            axes.annotate(
                f"{name}\n{value:.1f}", (1, value), (4, 0), xycoords=("axes fraction", "data"),
                textcoords="offset points", va="center", color=colour,
            )  # fmt: skip
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")


def _handles(runs: Mapping[str, Sequence[Run]], strokes: Mapping[str, style.Stroke]) -> list[Artist]:
    """A line for each label, then what dots, thin lines and bands mean."""
    handles: list[Artist] = []
    for label, stroke in strokes.items():
        seeds = f" ({len(runs[label])} runs)" if len(runs[label]) > 1 else ""
        handles.append(Line2D([], [], color=stroke.colour, ls=stroke.linestyle, lw=2, label=label + seeds))
    grey = style.QUIET
    keys = {key for of_label in runs.values() for run in of_label for row in run for key in row}
    if EVALUATION in keys:
        handles.append(
            Line2D([], [], color=grey, lw=2, marker="o", ms=4.5, mec=style.PAPER, mew=0.6, label="evaluation")
        )
    if TRAINING in keys:
        handles.append(Line2D([], [], color=grey, lw=0.9, label="training"))
    if any(len(of_label) > 1 for of_label in runs.values()):
        handles.append(Patch(color=grey, alpha=0.3, lw=0, label="95 % interval of the mean"))
    return handles


def unit_of_frames(reached: float) -> tuple[float, str]:
    """How many frames the unit of the axis is, and its name, where it goes up to `reached`."""
    return next(((size, unit) for size, unit in UNITS.items() if reached >= size), (1.0, "frames"))


def mean_curve(runs: Sequence[Run], key: str) -> tuple[Array, Array, Array, Array]:
    """Frames, mean over the runs, and the ends of the mean's 95 % interval, each [P]; P is 0 if no run has the key."""
    curves = [curve for curve in (points(run, key) for run in runs) if len(curve)]
    none = np.empty(0)
    if not curves:
        return none, none, none, none
    start, end = max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves)
    frames = np.unique(np.concatenate([curve[:, 0] for curve in curves]))
    frames = frames[(frames >= start) & (frames <= end)]
    values = np.stack([np.interp(frames, *curve.T) for curve in curves])
    mean = values.mean(axis=0)
    if len(curves) == 1:
        return frames, mean, mean, mean
    # The same resamples at every point keep the band as smooth as the curves, and every picture of a run the same.
    chosen = np.random.default_rng(0).integers(len(curves), size=(RESAMPLES, len(curves)))
    weights = (chosen[..., None] == np.arange(len(curves))).mean(axis=1)
    low, high = np.percentile(weights @ values, [2.5, 97.5], axis=0)
    return frames, mean, low, high


def points(run: Run, key: str) -> Array:
    """[P, 2]: frames and value of the rows that have one, by frames."""
    found = []
    for row in run:
        if "frames" not in row:
            raise ValueError(f"A row of a learning curve has no 'frames'; it has: {', '.join(row) or 'nothing'}.")
        found.append((_number(row["frames"]), _number(row.get(key))))
    curve = np.array(found, dtype=np.float64).reshape(-1, 2)
    curve = curve[np.isfinite(curve).all(axis=1)]
    ordered: Array = curve[np.argsort(curve[:, 0], kind="stable")]
    return ordered


def _number(value: object) -> float:
    return float("nan") if value is None else float(cast(SupportsFloat, value))
