"""Learning curves of many labels: a small picture each, the others faint behind it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coil_rl.files import whole_file
from coil_rl.report import style
from coil_rl.report.curve import TRAINING, Run, mean_curve, unit_of_frames

COLUMNS = 3  # at most
ROW = 1.55  # inches
AXIS = 0.35  # inches, as the next
GAP = 0.06


def draw_curve_grid(
    runs: Mapping[str, Sequence[Run]],
    path: str | os.PathLike[str],
    *,
    guides: Mapping[str, float] | None = None,
    title: str | None = None,
) -> None:
    """Draw the mean return in training of each label with the 95 % bootstrap interval of that mean.

    Args:
        runs: as in `draw_learning_curves`.
        path: the picture, in the format of its ending, 8 inches wide.
        guides: from label to the mean return of its guide, drawn as a dashed line.
        title: above the picture.

    Raises:
        ValueError: if there is no label, or a row has no frames.
    """
    if not runs:
        raise ValueError("A grid of learning curves needs at least one label; got none.")
    curves = {label: mean_curve(of_label, TRAINING) for label, of_label in runs.items()}
    size, unit = unit_of_frames(max((frames[-1] for frames, *_ in curves.values() if len(frames)), default=0.0))
    columns = min(COLUMNS, len(runs))
    rows = -(-len(runs) // columns)
    with mpl.rc_context(style.LETTERS):
        figure = Figure(figsize=(style.WIDTH, 1), dpi=style.RESOLUTION)
        FigureCanvasAgg(figure)
        header = style.draw_header(figure, _handles(bool(guides)), title) + GAP
        height = header + AXIS + ROW * rows
        figure.set_figheight(height)
        figure.set_layout_engine("constrained", rect=(0, 0, 1, 1 - header / height), w_pad=style.MARGIN / 2, h_pad=0.08)
        grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat
        for axes, (label, (frames, mean, low, high)) in zip(grid, curves.items(), strict=False):
            for other, (at, values, _, _) in curves.items():
                if other != label:
                    axes.plot(at / size, values, color=style.KERB, lw=0.6, alpha=0.7)
            axes.fill_between(frames / size, low, high, color=style.AGENTS[0], alpha=0.25, lw=0, zorder=2.1)
            axes.plot(frames / size, mean, color=style.AGENTS[0], lw=1.5, zorder=2.2)
            if guides and label in guides:
                axes.axhline(guides[label], color=style.GUIDES[0], ls=(0, style.DASHES), lw=1.0)
            axes.set_title(f"{label} ({len(runs[label])} runs)" if len(runs[label]) > 1 else label, size=9, loc="left")
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_xlim(left=0)
            axes.tick_params(labelbottom=True)
        for axes in figure.axes[len(runs) :]:
            axes.remove()
        for axes in figure.axes[:-columns]:
            axes.tick_params(labelbottom=False)
        figure.supxlabel(unit, size=9)
        figure.supylabel("return (sum of rewards of an episode)", size=9)
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format=Path(path).suffix[1:] or "png")


def _handles(guided: bool) -> list[Artist]:
    handles: list[Artist] = [
        Line2D([], [], color=style.AGENTS[0], lw=1.5, label="training, mean of the runs"),
        Patch(color=style.AGENTS[0], alpha=0.25, lw=0, label="95 % interval of the mean"),
        Line2D([], [], color=style.KERB, lw=0.6, label="the others"),
    ]
    if guided:
        handles.append(Line2D([], [], color=style.GUIDES[0], ls=(0, style.DASHES), lw=1.0, label="its guide"))
    return handles
