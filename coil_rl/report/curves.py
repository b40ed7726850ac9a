"""Evaluation curves: drawn in one plot or in a grid, and in numbers.

For a run of Dynamic COIL they are drawn with the phases of the training.
"""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter

from coil_rl.report import style
from coil_rl.report.runs import CHOICE, RETURN, Run
from coil_rl.report.statistics import Array, mean_interval
from coil_rl.report.table import return_format

Rows = Sequence[Mapping[str, object]]

RETURNS = "return in evaluation"
GRID_COLUMNS = 3
GRID_ROW_HEIGHT = 1.55  # inches
FEW_SEEDS = 5  # up to here each seed is a line: the interval of a few hides what they did
AGENT = "#1a1a1a"  # the agent in `draw_phases`


def draw_learning_curves(
    runs: Mapping[str, Sequence[Rows]],
    path: style.Target,
    *,
    strokes: Mapping[str, style.Stroke] | None = None,
    guides: Mapping[str, float] | None = None,
    title: str | None = None,
    cases: int | None = None,
    least: float | None = None,
) -> None:
    """Draw the return of the kept policies against frames, one curve per label.

    Several runs of one label are drawn as their mean, over the frames that all of them reached,
    with each of them as a thin line, or with the 95 % t interval of the mean as a band if there are
    more than `FEW_SEEDS`.

    Args:
        runs: by label, one run per seed, at least one run in all. A run is a sequence of rows with
            "frames" (env frames so far) and "evaluation/return", which may be missing, None or NaN.
        path: output file, or a buffer for an SVG.
        strokes: by label; by default those of `style.strong_strokes`.
        guides: mean return of each guide by name, drawn as a dashed line.
        title: above the plot.
        cases: number of cases that each return is the mean of; None if it is not known.
        least: lower end of the axis: of a curve that ends below it the last value is said there.
    """
    returns = RETURNS if cases is None else f"{RETURNS}, mean of {cases} cases"
    curves = {label: mean_curve(seeds, RETURN) for label, seeds in runs.items()}
    strokes = strokes or style.strong_strokes(runs)
    named = {_with_count(label, seeds): strokes[label] for label, seeds in runs.items()}
    handles = style.handles(named, lw=2)
    handles += _spread_handles(runs.values(), style.QUIET)
    with style.picture(path, title, handles, 4.2) as figure:
        axes = figure.add_subplot(xlabel="frames", ylabel=returns)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        style.lighten(axes)
        for label, (frames, mean, *_) in curves.items():
            colour, linestyle = strokes[label]
            axes.plot(frames, mean, color=colour, ls=linestyle, lw=1.8)
            _draw_spread(axes, runs[label], curves[label], colour)
        axes.margins(x=0.02)
        axes.set_xlim(left=0)
        draw_guides(axes, guides or {})
        if least is not None:
            ends = {label: mean[-1] for label, (_, mean, *_) in curves.items() if len(mean)}
            _cut(axes, {label: end for label, end in ends.items() if end < least}, strokes, least)


def _cut(
    axes: Axes, below: Mapping[str, float], strokes: Mapping[str, style.Stroke], least: float
) -> None:
    """Let an axis begin at a value, and say there where curves end that are below it.

    Args:
        below: their last values, by label.
    """
    if not below:
        return
    axes.set_ylim(bottom=least)
    spec = return_format(below.values())
    for place, (label, end) in enumerate(sorted(below.items(), key=lambda each: -each[1])):
        axes.annotate(
            f"{label} ends at {end:{spec}} ↓",
            (0.99, 0),
            (0, 4 + 12 * (len(below) - 1 - place)),
            xycoords="axes fraction",
            textcoords="offset points",
            ha="right",
            color=strokes[label].colour,
        )


def draw_guides(axes: Axes, guides: Mapping[str, float]) -> None:
    """Draw the returns of guides as dashed lines.

    Their names are beside the plot, where no curve is.

    Args:
        guides: return by name.
    """
    for (name, value), colour in zip(guides.items(), cycle(style.GUIDES), strict=False):
        axes.axhline(value, color=colour, ls=style.DASHED, lw=1.3, zorder=1.5)
        axes.annotate(
            f"{name}\n{value:{return_format([value])}}",
            (1, value),
            (4, 0),
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
            va="center",
            color=colour,
        )


def _is_few(seeds: Sequence[Rows]) -> bool:
    """Return whether the seeds of a label are drawn as lines."""
    return 1 < len(seeds) <= FEW_SEEDS


def _spread_handles(runs: Iterable[Sequence[Rows]], colour: str) -> list[Artist]:
    """Return the handles of what `_draw_spread` draws."""
    runs, handles = list(runs), list[Artist]()
    if any(_is_few(seeds) for seeds in runs):
        handles.append(Line2D([], [], color=colour, lw=0.8, alpha=0.6, label="one seed"))
    if any(len(seeds) > FEW_SEEDS for seeds in runs):
        handles.append(Patch(color=colour, alpha=0.3, lw=0, label="95 % interval of the mean"))
    return handles


def _draw_spread(
    axes: Axes, seeds: Sequence[Rows], curve: tuple[Array, Array, Array, Array], colour: str
) -> None:
    """Draw what the seeds of a label differ by: few as thin lines, more as a band.

    Args:
        curve: their `mean_curve`.
    """
    if _is_few(seeds):
        for run in seeds:
            axes.plot(*points(run, RETURN).T, color=colour, lw=0.8, alpha=0.6, zorder=1.8)
        return
    frames, _, low, high = curve
    axes.fill_between(frames, low, high, color=colour, alpha=0.2, lw=0)


def _with_count(label: str, runs: Sequence[Rows]) -> str:
    """Return a label with the number of its runs if there are several."""
    return f"{label} ({len(runs)} runs)" if len(runs) > 1 else label


def draw_curve_grid(
    runs: Mapping[str, Sequence[Rows]],
    path: style.Target,
    *,
    strokes: Mapping[str, style.Stroke] | None = None,
    guides: Mapping[str, float] | None = None,
) -> None:
    """Draw one small learning curve per label, with the other labels faint behind it.

    Args:
        runs: by label, at least one, the runs as in `draw_learning_curves`.
        path: output file, or a buffer for an SVG.
        strokes: by label; by default those of `style.strong_strokes`.
        guides: mean return of the guide of each label, drawn as a dashed line.
    """
    curves = {label: mean_curve(seeds, RETURN) for label, seeds in runs.items()}
    strokes, rows = strokes or style.strong_strokes(runs), -(-len(runs) // GRID_COLUMNS)
    guide_line: dict[str, Any] = {"color": style.GUIDES[0], "ls": style.DASHED, "lw": 1.0}
    handles: list[Artist] = [Line2D([], [], color=style.INK, lw=1.5, label="mean of the runs")]
    handles += _spread_handles(runs.values(), style.INK)
    handles.append(Line2D([], [], color=style.KERB, lw=0.6, label="the others"))
    if guides:
        handles.append(Line2D([], [], label="its guide", **guide_line))
    height = 0.35 + GRID_ROW_HEIGHT * rows
    with style.picture(path, None, handles, height, add_header=True, h_pad=0.08) as figure:
        titles = [_with_count(label, seeds) for label, seeds in runs.items()]
        grid = style.panels(figure, titles, GRID_COLUMNS)
        for axes, (label, curve) in zip(grid, curves.items(), strict=True):
            colour = strokes[label].colour
            for other_frames, other_mean, *_ in curves.values():  # its own is drawn over
                axes.plot(other_frames, other_mean, color=style.KERB, lw=0.6, alpha=0.7)
            _draw_spread(axes, runs[label], curve, colour)
            axes.plot(*curve[:2], color=colour, lw=1.5, zorder=2.2)
            if guides and label in guides:
                axes.axhline(guides[label], **guide_line)
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_xlim(left=0)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.tick_params(labelbottom=True)
        figure.supxlabel("frames", size=9)
        figure.supylabel(RETURNS, size=9)


def draw_phases(
    rows: Sequence[Mapping[str, float]],
    guides: Sequence[str],
    path: str | os.PathLike[str],
    *,
    title: str | None = None,
) -> None:
    """Draw one run of Dynamic COIL: returns, change of each guide's action, and learning rates.

    The background has the colour of the guide that is trained.

    Args:
        rows: of `metrics.csv`, at least one.
        guides: names of the guides in the order of the run.
        title: above the plot.
    """
    colours = [style.AGENTS[index % len(style.AGENTS)] for index in range(len(guides))]
    # Without the row of the state before the first update.
    updates = [row for row in rows if not math.isnan(row["learner/guide"])]
    handles: list[Artist] = [Line2D([], [], color=AGENT, lw=1.6, label="agent")]
    alone: dict[str, Any] = {"ls": style.DASHED, "lw": 1.1, "marker": "o", "ms": 4}
    for name, colour in zip(guides, colours, strict=True):
        handles.append(Line2D([], [], color=colour, label=f"{name} alone", **alone))
    handles.append(Patch(color=style.QUIET, alpha=0.25, lw=0, label="a guide learns (its colour)"))
    with style.picture(path, title, handles, 6.8, h_pad=0.08) as figure:
        top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(2.4, 1, 1))
        top.plot(*points(rows, RETURN).T, color=AGENT, lw=1.6, marker="o", ms=3)
        frames = _column(updates, "frames")
        for name, colour in zip(guides, colours, strict=True):
            top.plot(*points(rows, f"guide/{name}").T, color=colour, **alone)
            middle.plot(frames, _column(updates, f"learner/moved_{name}"), color=colour, lw=1.4)
        _draw_learning_rates(bottom, updates, colours)
        labels = {top: "return", middle: "moved (action)", bottom: "learning rate"}
        for axes, label in labels.items():
            style.lighten(axes)
            axes.set(ylabel=label, xmargin=0, xlim=(0, None))
            _mark_phases(axes, updates, colours)
        middle.set_ylim(bottom=0)
        bottom.set_xlabel("frames")
        bottom.xaxis.set_major_formatter(EngFormatter(sep=""))


def _draw_learning_rates(
    axes: Axes, updates: Sequence[Mapping[str, float]], colours: Sequence[str]
) -> None:
    """Draw the learning rates of the agent and of the guides, which have the given colours."""
    # Index of the guide that learns; their number if all of them do.
    learner = _column(updates, "learner/guide")
    guide_rate = _column(updates, "learner/guide_learning_rate")
    rates = {AGENT: _column(updates, "learner/learning_rate")}
    for index, colour in enumerate(colours):
        learns = (learner == index) | (learner == len(colours))
        rates[colour] = np.where(learns, guide_rate, np.nan)
    edges = np.concatenate([[0.0], _column(updates, "frames")])
    for colour, values in rates.items():
        # A logarithmic axis cannot show 0.
        visible = np.where(values > 0, values, np.nan)
        axes.stairs(visible, edges, color=colour, lw=1.6, baseline=None)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")


def _mark_phases(
    axes: Axes, updates: Sequence[Mapping[str, float]], colours: Sequence[str]
) -> None:
    """Give the background the colour of the guide that learns; none if it is not exactly one."""
    frames = _column(updates, "frames")
    learner = _column(updates, "learner/guide").astype(int)
    starts = np.concatenate([[0.0], frames])
    for start, end, index in zip(starts, frames, learner, strict=False):
        if 0 <= index < len(colours):
            axes.axvspan(start, end, color=colours[index], alpha=0.12, lw=0)


def mean_curve(runs: Sequence[Rows], key: str) -> tuple[Array, Array, Array, Array]:
    """Return the mean curve of several runs.

    Args:
        runs: one run per seed, see `draw_learning_curves`.

    Returns:
        The frames, the mean over the runs, and the low and the high end of its 95 % t interval, [P]
        each; P = 0 without data. A single run has no interval: both ends are its values.
    """
    curves = [curve for curve in (points(run, key) for run in runs) if len(curve)]
    if not curves:
        return (np.empty(0),) * 4
    start, end = max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves)
    frames = np.unique(np.concatenate([curve[:, 0] for curve in curves]))
    frames = frames[(frames >= start) & (frames <= end)]
    values = np.stack([np.interp(frames, *curve.T) for curve in curves])
    if len(curves) == 1:
        return frames, *values, *values, *values
    return frames, *mean_interval(values)


def learning(run: Run) -> dict[str, float]:
    """Return the evaluation curve of a run in numbers, NaN where unknown.

    These are the `frames` of the run; the return of the `first`, the `final` and the `best` policy,
    which is chosen in other cases, if there are any, with the frames `best_at`; the mean of the
    curve (`area`, under the curve divided by the frames); the return of the best `guide`, and the
    frames `until_guide`, its level.

    Args:
        run: with or without a curve.
    """
    curve, choice = points(run.curve, RETURN), points(run.curve, CHOICE)
    names = ("frames", "guide", "first", "final", "best", "best_at", "area", "until_guide")
    found = dict.fromkeys(names, math.nan)
    found["guide"] = guide_return([run])
    if run.curve:
        found["frames"] = run.curve[-1]["frames"]
    if not len(curve):
        return found
    at, values = curve.T
    found |= {"first": values[0], "final": values[-1], "area": values[0]}
    if len(at) > 1:
        found["area"] = np.trapezoid(values, at) / (at[-1] - at[0])
    if len(choice) == len(curve):
        found["best_at"], found["best"] = curve[choice[:, 1].argmax()]
    found["until_guide"] = frames_until(at, values, found["guide"])
    return found


def guide_return(runs: Iterable[Run]) -> float:
    """Return the mean over runs of the return of their best guide; NaN without a guide.

    Args:
        runs: of which those count that know it, in the cases of their curves.
    """
    returns = [max(run.guide_returns.values()) for run in runs if run.guide_returns]
    return float(np.mean(returns)) if returns else math.nan


def frames_until(
    frames: Sequence[float] | Array, returns: Sequence[float] | Array, level: float
) -> float:
    """Return the frames at which a curve first reaches a level; NaN if it never does.

    Between two points of the curve the frames are interpolated linearly.

    Args:
        frames: of the points of the curve, [P].
        returns: of the points of the curve, [P].
        level: the return to reach.
    """
    reached = np.flatnonzero(np.asarray(returns) >= level)
    if not len(reached):
        return math.nan
    part = slice(max(int(reached[0]) - 1, 0), int(reached[0]) + 1)
    return float(np.interp(level, returns[part], frames[part]))


def points(run: Rows, key: str) -> Array:
    """Return frames and values [P, 2] of the rows with a finite value, sorted by frames.

    Args:
        run: rows of `metrics.csv`.
    """
    table = np.stack([_column(run, "frames"), _column(run, key)], axis=1)
    known = table[np.isfinite(table).all(axis=1)]
    return known[known[:, 0].argsort(kind="stable")]


def _column(rows: Rows, key: str) -> Array:
    return np.array([row.get(key, np.nan) for row in rows], dtype=np.float64)
