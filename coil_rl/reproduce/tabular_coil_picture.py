"""The picture of `TabularCoil`: how often COIL is at least its guide, and how well it and plain Q-learning do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation

from coil_rl.report import style
from coil_rl.report.style import lighten, picture

HEIGHT = 5.6  # inches
APART = 1.6  # points between lines that would else lie on each other
LOWEST = -0.2  # score that is shown
PLAIN = "#1a1a1a"


def draw(groups: Sequence[Mapping[str, Any]], steps: Sequence[int], path: Path) -> None:
    """Draw it: a column for each thing the agent sees, shares above, scores below.

    Args:
        groups: with `sees`, `guide`, `shares` [K], `coil_scores` [K], `plain_scores` [K] and `guide_score`.
        steps: [K], of experience.
        path: the picture, 8 inches wide.
    """
    views, guides = (list(dict.fromkeys(group[key] for group in groups)) for key in ("sees", "guide"))
    colours = dict(zip(guides, style.AGENTS, strict=False))
    handles: list[Artist] = [
        Line2D([], [], color=colour, lw=2, marker="o", ms=4, label=f"COIL, guide {name}")
        for name, colour in colours.items()
    ]
    handles.append(Line2D([], [], color=PLAIN, lw=1.6, ls=(0, style.SECOND_ROUND), label="plain Q-learning"))
    handles.append(Line2D([], [], color=style.QUIET, lw=1.2, ls=(0, style.DASHES), label="guide alone (its colour)"))
    with picture(path, "Tabular COIL and its guides", handles, HEIGHT) as figure:
        grid = figure.subplots(2, len(views), sharex=True, sharey="row", squeeze=False)
        for column, view in enumerate(views):
            share, score = grid[:, column]
            of_view = [group for group in groups if group["sees"] == view]
            for place, group in enumerate(of_view):
                line = {"color": colours[group["guide"]], "lw": 2, "marker": "o", "ms": 4}
                aside = ScaledTranslation(0, (place - 1.5) * APART / 72, figure.dpi_scale_trans)
                share.plot(steps, group["shares"], transform=share.transData + aside, clip_on=False, **line)
                score.plot(steps, group["coil_scores"], **line)
                score.axhline(group["guide_score"], color=line["color"], lw=1.2, ls=(0, style.DASHES), zorder=1.5)
                if group["guide_score"] < LOWEST:
                    score.annotate(
                        f"↓ guide {group['guide']} at {group['guide_score']:.2f}", (0, 0), (4, 4),
                        xycoords="axes fraction", textcoords="offset points", color=line["color"],
                    )  # fmt: skip
            score.plot(steps, of_view[0]["plain_scores"], color=PLAIN, lw=1.6, ls=(0, style.SECOND_ROUND))
            share.set_title(f"the agent sees {view}", size=9, loc="left", color=style.QUIET)
            score.set_xlabel("steps of experience")
            for axes in (share, score):
                _lay_out(axes, steps)
        grid[0, 0].set(ylabel="worlds where COIL\nis at least the guide", ylim=(0, 1))
        grid[0, 0].yaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
        grid[1, 0].set(ylabel="mean score\n(0 random, 1 optimal)", ylim=(LOWEST, 1.05))


def _lay_out(axes: Axes, steps: Sequence[int]) -> None:
    lighten(axes)
    axes.set_xscale("log")
    axes.set_xticks(steps, [f"{n:,}" for n in steps])
    axes.minorticks_off()
