"""Figure 6 of the paper: how value iteration comes to what the toymaker's states are worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.lines import Line2D

from coil_rl.report import markdown_table, style, write_csv
from coil_rl.report.style import lighten, picture
from coil_rl.reproduce.result import NO_RUNS, Result, Runs
from coil_rl.tabular import policy_iteration, toymaker, value_iteration

PAPER = 80  # "converges after about 80 iterations"
SHARES = (0.1, 0.05, 0.02, 0.01, 0.001)

COLUMNS = {"short": ("short of its limit by", ".1%"), "ours": ("iterations", "d"), "paper": ("paper", "")}


class Figure6(Result):
    """V of both states after each iteration from 0.

    Args:
        iterations: that the picture shows.
    """

    def __init__(self, iterations: int = 160) -> None:
        if iterations < 1:
            raise ValueError(f"iterations={iterations} must be at least 1")
        self.iterations = iterations

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        mdp = toymaker()
        limit, history = policy_iteration(mdp).V, value_iteration(mdp).history
        short = (np.abs(history - limit) / np.abs(limit)).max(axis=1)
        shown = min(self.iterations, len(history) - 1)
        rows = [
            {"iteration": k} | dict(zip(mdp.states, history[k], strict=True)) | {"short": short[k]}
            for k in range(shown + 1)
        ]
        write_csv(rows, stem.with_suffix(".csv"))
        handles: list[Artist] = [
            Line2D([], [], color=colour, lw=2, label=f"V of {state}")
            for state, colour in zip(mdp.states, style.AGENTS, strict=False)
        ]
        handles.append(Line2D([], [], color=style.QUIET, ls=(0, style.DASHES), lw=1.3, label="limit"))
        with picture(stem.with_suffix(".png"), "Figure 6: value iteration on the toymaker", handles, 4.2) as figure:
            axes = figure.add_subplot(xlabel="iteration", ylabel="V", xlim=(0, shown))
            lighten(axes)
            for s, colour in zip(range(len(limit)), style.AGENTS, strict=False):
                axes.plot(history[: shown + 1, s], color=colour, lw=2)
                axes.axhline(limit[s], color=style.QUIET, ls=(0, style.DASHES), lw=1.3, zorder=1.5)
            if shown > PAPER:
                axes.axvline(PAPER, color=style.KERB, lw=1)
                axes.annotate(
                    f"paper: converged\nafter about {PAPER}", (PAPER, 0), (4, 6), xycoords=("data", "axes fraction"),
                    textcoords="offset points", color=style.QUIET,
                )  # fmt: skip
        table = [{"short": share, "ours": int((short > share).sum()), "paper": f"about {PAPER}"} for share in SHARES]
        worth = ", ".join(
            f"{value:.2f} of {limit[s]:.2f}" for s, value in enumerate(history[min(PAPER, len(short) - 1)])
        )
        notes = f"After {PAPER} iterations V is {worth}. The paper does not say what it calls converged."
        return f"## Figure 6: value iteration on the toymaker\n\n{markdown_table(table, COLUMNS)}\n\n{notes}"
