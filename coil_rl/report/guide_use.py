"""How much of its guide each method uses over a training: what its runs have logged of it.

Which columns of `metrics.csv` say so is in `conf/tables.yaml`.
"""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.ticker import EngFormatter

from coil_rl.report import style
from coil_rl.report.curves import points
from coil_rl.report.runs import Run
from coil_rl.report.statistics import Array
from coil_rl.report.table import TABLES

PANEL_HEIGHT = 1.5  # inches

Use = Mapping[str, Mapping[str, Sequence[Array]]]


def guide_use(runs: Sequence[Run]) -> Use:
    """Return what is known of the use of guides, by column and label.

    Returns:
        For each column that any run has, and each label that has it, the points [P, 2] (frames and
        value) of each of its runs. A column with one value, such as a weight that is decided before
        the training, has it at the first and the last frames.
    """
    found: dict[str, dict[str, list[Array]]] = {}
    for column, run in itertools.product(TABLES["guide_use"], runs):
        known = points(run.curve, column)
        if len(known) == 1:
            ends = run.curve[0]["frames"], run.curve[-1]["frames"]
            known = np.array([[frames, known[0, 1]] for frames in ends])
        if len(known):
            found.setdefault(column, {}).setdefault(run.label, []).append(known)
    return found


def draw_guide_use(use: Use, path: style.Target, strokes: Mapping[str, style.Stroke]) -> None:
    """Draw a panel for each column, with a line for each run in the colour of its label.

    Args:
        use: from `guide_use`, not empty.
        path: output file, or a buffer for an SVG.
        strokes: by label.
    """
    labels = dict.fromkeys(label for of_label in use.values() for label in of_label)
    handles = style.handles({label: strokes[label] for label in labels}, lw=2)
    height = 0.3 + PANEL_HEIGHT * len(use)
    with style.picture(path, None, handles, height, add_header=True, h_pad=0.08) as figure:
        panels = figure.subplots(len(use), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (column, of_label) in zip(panels, use.items(), strict=True):
            axes.set_title(TABLES["guide_use"][column], size=9, loc="left")
            style.lighten(axes)
            for label, curves in of_label.items():
                colour, linestyle = strokes[label]
                for curve in curves:
                    axes.plot(*curve.T, color=colour, ls=linestyle, lw=1.2, alpha=0.8)
            axes.margins(x=0.02)
            axes.set_xlim(left=0)
        panels[-1].set_xlabel("frames")
        panels[-1].xaxis.set_major_formatter(EngFormatter(sep=""))
