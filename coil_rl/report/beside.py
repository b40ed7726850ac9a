"""Each policy beside its guide, case by case: what a mean over the cases hides."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.lines import Line2D

from coil_rl.report import style
from coil_rl.report.statistics import Array

if TYPE_CHECKING:
    from coil_rl.report.comparison import Group

COLUMNS = 4  # of panels
PANEL_HEIGHT = 1.9  # inches
MAX_PANELS, MAX_CASES = 8, 500
BESIDE = (
    "A line for each case: return of the guide (left) and of the policy (right), means over seeds."
)

Beside = Mapping[str, Sequence[Array]]


def beside_guides(agents: Iterable[Group]) -> dict[str, tuple[Array, Array]]:
    """Return the returns of the guide and of each agent in each case, [cases] each, by its name.

    Agents without a guide, and those with altered advice, are left out.
    """
    return {
        group.name: (group.guide.returns.mean(0), group.returns.mean(0))
        for group in agents
        if group.guide and not group.advice and group.guide.cases == group.cases
    }


def draw_beside_guides(
    beside: Beside, path: style.Target, strokes: Mapping[str, style.Stroke]
) -> None:
    """Draw a panel for each policy, all on one axis, with a line for each case.

    Args:
        beside: from `beside_guides`, not empty; the first `MAX_PANELS` are drawn, and of each the
            first `MAX_CASES`.
        path: output file, or a buffer for an SVG.
        strokes: by label, for the colours.
    """
    shown = dict(list(beside.items())[:MAX_PANELS])
    rows = -(-len(shown) // COLUMNS)
    handles = [
        Line2D([], [], color=style.INK, label="better than the guide"),
        Line2D([], [], color=style.KERB, label="not better (grey)"),
    ]
    height = 0.3 + PANEL_HEIGHT * rows
    with style.picture(path, None, handles, height, add_header=True, h_pad=0.08) as figure:
        grid = style.panels(figure, list(shown), COLUMNS, size=8)
        for axes, (label, (guide, policy)) in zip(grid, shown.items(), strict=True):
            style.lighten(axes)
            for ends in np.stack([guide, policy], 1)[:MAX_CASES]:
                colour = strokes[label].colour if ends[1] > ends[0] else style.KERB
                axes.plot([0, 1], ends, "o-", color=colour, lw=1, ms=2.5, alpha=0.7)
            axes.set(xlim=(-0.15, 1.15), xticks=[0, 1], xticklabels=["guide", "policy"])
        figure.supylabel("return", size=9)
