"""Table 1 of the paper: what each action is worth to the toymaker."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coil_rl.report import markdown_table, style, write_csv
from coil_rl.report.style import lighten, picture
from coil_rl.reproduce.result import NO_RUNS, Result, Runs
from coil_rl.reproduce.verdict import FAILED, HEADING, HELD
from coil_rl.tabular import toymaker, value_iteration

PAPER = np.array([[41.37, 42.21], [31.42, 32.26]])
HALF = 0.005  # what rounding to two decimals may hide

COLUMNS = {
    "state": ("state", ""),
    "action": ("action", ""),
    "ours": ("Q", ".4f"),
    "printed": ("rounded", ".2f"),
    "paper": ("paper", ".2f"),
    "difference": ("difference", "+.4f"),
}


class Table1(Result):
    """Q of the toymaker by value iteration, to within the tolerance of the optimal one.

    Args:
        tolerance: largest error.
    """

    def __init__(self, tolerance: float = 1e-9) -> None:
        if not tolerance > 0:
            raise ValueError(f"tolerance={tolerance} must be more than 0")
        self.tolerance = tolerance

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        mdp = toymaker()
        Q = value_iteration(mdp, self.tolerance).Q
        rows = [
            {
                "state": state, "action": action, "ours": Q[s, a], "printed": Q[s, a], "paper": PAPER[s, a],
                "difference": Q[s, a] - PAPER[s, a],
            }
            for s, state in enumerate(mdp.states)
            for a, action in enumerate(mdp.actions)
        ]  # fmt: skip
        write_csv([{key: row[key] for key in row if key != "printed"} for row in rows], stem.with_suffix(".csv"))
        off = (Q - PAPER).flatten()
        _draw([f"{row['state']}, {row['action']}" for row in rows], off, stem.with_suffix(".png"))
        equal = int((np.abs(off) <= HALF).sum())
        notes = (
            f"{equal} of {len(off)} values round to what is printed; the largest difference is "
            f"{np.abs(off).max():.4f}. Value iteration that stops early is short of the optimum by nearly the same "
            f"amount everywhere; no such shortfall rounds to more than {most_explained(off)} of the printed values."
        )
        gain = Q[:, 1] - Q[:, 0]
        held = [
            {"claim": "Advertising is worth more in both states",
             "ours": f"**{HELD if (gain > 0).all() else FAILED}**: by " + " and ".join(f"{more:.4f}" for more in gain)},
            {"claim": "Q to two decimals",
             "ours": f"**{HELD if equal == len(off) else FAILED}**: {equal} of {len(off)} values, off by "
                     f"{np.abs(off).max():.4f} at most"},
        ]  # fmt: skip
        end = markdown_table(held, {"claim": ("the paper says", ""), "ours": ("ours", "")})
        return f"## Table 1: the toymaker's Q\n\n{markdown_table(rows, COLUMNS)}\n\n{notes}\n\n{HEADING}\n\n{end}"


def most_explained(off: np.ndarray) -> int:
    """How many of the differences a single shortfall, the same for all, can bring within rounding at most."""
    # The most intervals of this width that share a point share the beginning of one of them.
    begins = off - HALF
    return max(int(((begins <= begin) & (begin <= begins + 2 * HALF)).sum()) for begin in begins)


def _draw(labels: list[str], off: np.ndarray, path: Path) -> None:
    handles: list[Artist] = [
        Line2D([], [], color=style.AGENTS[0], ls="", marker="o", ms=6, label="ours - paper"),
        Patch(color=style.ASPHALT, lw=0, label="what two decimals cannot tell apart"),
    ]
    with picture(path, "Table 1: Q of the toymaker, beside the paper's", handles, height=2.4) as figure:
        axes = figure.add_subplot(xlabel="difference of Q")
        lighten(axes, grid="x")
        axes.axvspan(-HALF, HALF, color=style.ASPHALT, lw=0)
        axes.axvline(0, color=style.KERB, lw=1)
        axes.plot(off, range(len(off)), color=style.AGENTS[0], ls="", marker="o", ms=6)
        axes.set_yticks(range(len(off)), labels)
        axes.set_ylim(len(off) - 0.5, -0.5)
        reach = 1.15 * max(3 * HALF, float(np.abs(off).max()))
        axes.set_xlim(-reach, reach)
