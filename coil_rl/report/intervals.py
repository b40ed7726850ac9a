"""Interval plot: the return of each policy with its confidence interval, one row per policy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from coil_rl.report import style

if TYPE_CHECKING:
    from coil_rl.report.comparison import Group

COLOUR = style.AGENTS[0]
LEAST_SEEDS = 4  # of an interval in a picture
LONGEST_NAME = 50  # characters of the name of a row
CIRCLE: dict[str, Any] = {"ls": "", "marker": "o"}
BAR: dict[str, Any] = {"alpha": 0.38, "lw": 8, "solid_capstyle": "butt"}
SEED = CIRCLE | {"ms": 3.6, "mfc": style.QUIET, "mec": "none", "alpha": 0.5}
DOT = CIRCLE | {"ms": 5.5, "mec": style.BACKGROUND, "mew": 0.6}
HOLLOW = CIRCLE | {"ms": 5.0, "mfc": style.BACKGROUND, "mew": 1.1}
GUIDE: dict[str, Any] = {"color": style.GUIDES[0], "ls": style.DASHED, "lw": 1.3, "zorder": 1.5}


@dataclass(frozen=True)
class Interval:
    """One row of the plot.

    Args:
        label: name of the row.
        value: the dot.
        low: the left end of the bar; NaN for no bar.
        high: the right end of the bar; NaN for no bar.
        points: small dots, the values of single seeds.
        guide: value of the policy's guide, a dashed line; None for none.
        hollow: whether the dot is hollow, as for a variant of the policy above.
        colour: of dot and bar.
    """

    label: str
    value: float
    low: float = math.nan
    high: float = math.nan
    points: Sequence[float] = ()
    guide: float | None = None
    hollow: bool = False
    colour: str = COLOUR


def driver_intervals(
    groups: Iterable[Group], strokes: Mapping[str, style.Stroke] | None = None
) -> list[Interval]:
    """Return a row for the return of each policy, with its single seeds and its guide.

    An interval of fewer than `LEAST_SEEDS` seeds is so wide that it says nothing: these are dots.

    Args:
        groups: the policies, in the order of the rows.
        strokes: those of the policies by name, for their colours; by default those of
            `style.strong_strokes`.
    """
    groups, rows = list(groups), []
    strokes = strokes or style.strong_strokes(dict.fromkeys(group.name for group in groups))
    for group in groups:
        few = len(group.returns) < LEAST_SEEDS
        row = Interval(
            group.title,
            group.reward.mean,
            math.nan if few else group.reward.low,
            math.nan if few else group.reward.high,
            points=group.returns.mean(axis=1).tolist() if len(group.returns) > 1 else [],
            guide=group.guide.reward.mean if group.guide else None,
            hollow=bool(group.advice),
            colour=strokes[group.name].colour,
        )
        rows.append(row)
    return rows


def draw_intervals(
    panels: Mapping[str, Sequence[Interval]],
    path: style.Target,
    *,
    measure: str,
    title: str | None = None,
) -> None:
    """Draw one panel, or several side by side that share their rows.

    Args:
        panels: by heading, the rows of each panel; at least one row in all.
        path: output file, or a buffer for an SVG.
        title: above the plot.
    """
    rows = list(itertools.chain.from_iterable(panels.values()))
    labels = list(dict.fromkeys(row.label for row in rows))
    names = [
        each if len(each) <= LONGEST_NAME else f"{each[: LONGEST_NAME - 1]}…" for each in labels
    ]
    colours = {row.colour for row in rows}
    dot, hollow, bar = _marks(colours.pop() if len(colours) == 1 else style.INK)
    legend = {
        "all seeds": (dot, True),
        "all seeds, advice altered": (hollow, any(row.hollow for row in rows)),
        "95 % interval": (bar, any(math.isfinite(row.low) for row in rows)),
        "one seed": (SEED, any(row.points for row in rows)),
        "its guide": (GUIDE, any(row.guide is not None for row in rows)),
    }
    handles = [
        Line2D([], [], label=label, **stroke) for label, (stroke, used) in legend.items() if used
    ]
    height = 0.62 + 0.27 * len(labels)
    with style.picture(path, title, handles, height, add_header=True, h_pad=0.08) as figure:
        axes_row = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
        for axes, (heading, panel) in zip(axes_row, panels.items(), strict=True):
            axes.set_xlabel(measure)
            if len(panels) > 1:
                axes.set_title(heading, size=9, loc="left")
            draw_panel(axes, {labels.index(row.label): row for row in panel})
        axes_row[0].set(
            yticks=range(len(labels)), yticklabels=names, ylim=(len(labels) - 0.5, -0.5)
        )


def _marks(colour: str) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Return the dot, the hollow dot and the bar in a colour."""
    return DOT | {"mfc": colour}, HOLLOW | {"mec": colour}, BAR | {"color": colour}


def draw_panel(axes: Axes, rows: Mapping[int, Interval]) -> None:
    """Draw rows at their y positions.

    Args:
        rows: by y position.
    """
    style.lighten(axes, grid="x")
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.margins(x=0.06)
    for y, row in rows.items():
        dot, hollow, bar = _marks(row.colour)
        axes.plot([row.low, row.high], [y, y], **bar)
        axes.plot(row.points, [y] * len(row.points), **SEED)
        axes.plot(row.value, y, **(hollow if row.hollow else dot))
    # Adjacent rows with the same guide share a line: separate dashes would not join.
    for value, adjacent in itertools.groupby(sorted(rows), key=lambda y: rows[y].guide):
        ys = list(adjacent)
        if value is not None:
            axes.plot([value, value], [ys[0] - 0.5, ys[-1] + 0.5], **GUIDE)
