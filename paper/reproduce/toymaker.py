"""Table 1 and figure 6 of the paper: the toymaker's values, and how value iteration converges."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from coil_paper.reproduce import pages
from coil_paper.reproduce.result import NO_RUNS, PAGES, Result, Runs
from coil_paper.tabular import policy_iteration, toymaker, value_iteration
from coil_paper.tabular.mdp import Array
from coil_rl.ranges import Count, Positive, checked
from coil_rl.report import markdown_table, style, write_csv

PAPER_Q = np.array(PAGES["table_1"]["paper"])
PAPER_ITERATIONS = 80  # "converges after about 80 iterations"
ROUNDING = 0.005  # largest rounding error of two decimals
SHARES = (0.1, 0.05, 0.02, 0.01, 0.001)


@checked
class Table1(Result):
    """Q of the toymaker, by value iteration.

    Args:
        tolerance: the largest error of Q, more than 0.
    """

    def __init__(self, tolerance: Positive = 1e-9) -> None:
        self.tolerance = tolerance

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        mdp = toymaker()
        Q = value_iteration(mdp, self.tolerance).Q
        difference = (Q - PAPER_Q).flatten()
        names = [f"{state}, {action}" for state in mdp.states for action in mdp.actions]
        frame = pd.DataFrame(
            {
                "state": np.repeat(mdp.states, len(mdp.actions)),
                "action": np.tile(mdp.actions, len(mdp.states)),
                "ours": Q.flatten(),
                "paper": PAPER_Q.flatten(),
                "difference": difference,
            }
        )
        rows = frame.to_dict("records")
        write_csv(rows, stem.with_suffix(".csv"))
        _draw_differences(names, difference, stem.with_suffix(".png"))
        columns = {
            "state": ("state", ""),
            "action": ("action", ""),
            "ours": ("Q", ".4f"),
            "rounded": ("rounded", ".2f"),
            "paper": ("paper", ".2f"),
            "difference": ("difference", "+.4f"),
        }
        table = markdown_table([row | {"rounded": row["ours"]} for row in rows], columns)
        notes = (
            f"{_equal(difference)} of {len(difference)} values round to the printed ones; "
            f"the largest difference is {np.abs(difference).max():.4f}. "
            "Value iteration that stops early is short of the optimum by nearly the same amount "
            "everywhere; no such shortfall rounds to more than "
            f"{most_explained(difference)} of the printed values."
        )
        gain, equal = Q[:, 1] - Q[:, 0], _equal(difference)
        gains = "by " + " and ".join(f"{of_state:.4f}" for of_state in gain)
        details = (
            f"{equal} of {len(difference)} values, off by {np.abs(difference).max():.4f} at most"
        )
        claims = [
            {
                "claim": "Advertising is worth more in both states",
                "ours": pages.certain_verdict(bool((gain > 0).all()), gains),
            },
            {
                "claim": "Q to two decimals",
                "ours": pages.certain_verdict(equal == len(difference), details),
            },
        ]
        section = pages.claims_section(claims, {"ours": "ours"})
        return f"## Table 1: the toymaker's Q\n\n{table}\n\n{notes}\n\n{section}"


def _equal(differences: Array) -> int:
    """Return the number of values that round to the printed ones."""
    return int((np.abs(differences) <= ROUNDING).sum())


@checked
class Figure6(Result):
    """V of both states after each of the first steps of value iteration.

    Args:
        iterations: number of steps in the picture, at least 1.
    """

    def __init__(self, iterations: Count = 160) -> None:
        self.iterations = iterations

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        mdp = toymaker()
        limit, history = policy_iteration(mdp).V, value_iteration(mdp).history
        error = (np.abs(history - limit) / np.abs(limit)).max(axis=1)
        shown = history[: self.iterations + 1]
        table = pd.DataFrame(shown, columns=list(mdp.states)).rename_axis("iteration")
        table["short"] = error[: len(shown)]
        write_csv(table.reset_index().to_dict("records"), stem.with_suffix(".csv"))
        _draw_convergence(mdp.states, shown, limit, stem.with_suffix(".png"))
        after = history[min(PAPER_ITERATIONS, len(history) - 1)]
        reached = ", ".join(
            f"{value:.2f} of {final:.2f}" for value, final in zip(after, limit, strict=True)
        )
        notes = (
            f"After {PAPER_ITERATIONS} iterations V is {reached}. "
            "The paper does not define convergence."
        )
        return (
            "## Figure 6: value iteration on the toymaker\n\n"
            f"{_convergence_table(error)}\n\n{notes}"
        )


def _convergence_table(error: Array) -> str:
    """Return the table of the iterations until V is near its limit.

    Args:
        error: [K + 1], the largest relative error of V after each of the K iterations.
    """
    paper = f"about {PAPER_ITERATIONS}"
    rows = [
        {"short": share, "ours": int((error > share).sum()), "paper": paper} for share in SHARES
    ]
    columns = {
        "short": ("short of its limit by", ".1%"),
        "ours": ("iterations", "d"),
        "paper": ("paper", ""),
    }
    return markdown_table(rows, columns)


def most_explained(differences: Array) -> int:
    """Return the largest number of differences that one common shift brings within rounding.

    Args:
        differences: between our values and the printed ones, [N].
    """
    # Each difference is explained by an interval of shifts. Among intervals of equal width, the
    # most that share a point share the lower end of one of them.
    lower = differences - ROUNDING
    return max(int(((lower <= end) & (end <= lower + 2 * ROUNDING)).sum()) for end in lower)


def _draw_differences(labels: list[str], differences: Array, path: Path) -> None:
    handles: list[Artist] = [
        Line2D([], [], color=style.AGENTS[0], ls="", marker="o", ms=6, label="ours - paper"),
        Patch(color=style.ASPHALT, lw=0, label="rounding to two decimals"),
    ]
    title = "Table 1: Q of the toymaker, beside the paper's"
    with style.picture(path, title, handles, height=2.4) as figure:
        axes = figure.add_subplot(xlabel="difference of Q")
        style.lighten(axes, grid="x")
        axes.axvspan(-ROUNDING, ROUNDING, color=style.ASPHALT, lw=0)
        axes.axvline(0, color=style.KERB, lw=1)
        rows = range(len(differences))
        axes.plot(differences, rows, color=style.AGENTS[0], ls="", marker="o", ms=6)
        axes.set_yticks(range(len(differences)), labels)
        reach = 1.15 * max(3 * ROUNDING, float(np.abs(differences).max()))
        axes.set(xlim=(-reach, reach), ylim=(len(differences) - 0.5, -0.5))


def _draw_convergence(states: tuple[str, ...], history: Array, limit: Array, path: Path) -> None:
    dashes: Any = {"color": style.QUIET, "ls": style.DASHED, "lw": 1.3}
    colours = dict(zip(states, style.AGENTS, strict=False))
    handles: list[Artist] = []
    for state, colour in colours.items():
        handles.append(Line2D([], [], color=colour, lw=2, label=f"V of {state}"))
    handles.append(Line2D([], [], label="limit", **dashes))
    with style.picture(path, "Figure 6: value iteration on the toymaker", handles, 4.2) as figure:
        axes = figure.add_subplot(xlabel="iteration", ylabel="V", xlim=(0, len(history) - 1))
        style.lighten(axes)
        for values, final, colour in zip(history.T, limit, colours.values(), strict=True):
            axes.plot(values, color=colour, lw=2)
            axes.axhline(final, zorder=1.5, **dashes)
        if len(history) > PAPER_ITERATIONS + 1:
            axes.axvline(PAPER_ITERATIONS, color=style.KERB, lw=1)
            axes.annotate(
                f"paper: converged\nafter about {PAPER_ITERATIONS}",
                (PAPER_ITERATIONS, 0),
                (4, 6),
                xycoords=("data", "axes fraction"),
                textcoords="offset points",
                color=style.QUIET,
            )
