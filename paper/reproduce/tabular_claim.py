"""The claim that COIL is "at least as good as its guide" (paper 3.2), tested with tabular COIL.

Q-learning with a guide's advice on random worlds, small enough to compute the value of each policy
exactly, so that every case is a yes or a no; next to it Q-learning without advice. The agent
observes the state, or only its class out of a few; the guide always observes the state.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.transforms import ScaledTranslation
from scipy.stats import binomtest
from tqdm import tqdm

from coil_paper import tabular
from coil_paper.reproduce import pages
from coil_paper.reproduce.result import NO_RUNS, PAGES, Result, Runs
from coil_paper.tabular.coil import noisy_guide, optimal_guide, random_guide, worst_guide
from coil_paper.tabular.learning import Epsilon, Power
from coil_paper.tabular.mdp import Array, Integers
from coil_rl.ranges import Count, Share, checked
from coil_rl.report import markdown_table, style, write_csv

NEARLY = 0.01  # of a score
ROUNDING = 1e-9  # scores of equal policies differ by less
LOWEST_SCORE = -0.2  # in the picture
LINE_OFFSET = 1.6  # points between coinciding lines
PLAIN: Any = {"color": style.INK, "lw": 1.6, "ls": style.SECOND_ROUND}


@checked
@dataclass(eq=False)
class TabularCoil(Result):
    """Tabular COIL with guides of different quality.

    Args:
        worlds: number of random worlds; world k has the seed k.
        states: number of states of each world, at least 3.
        actions: number of actions of each world.
        classes: number of classes of states, at most `states`; the agent that observes classes does
            not observe the state.
        noise: probability of a random action of the noisy guide.
        epsilon: probability of a random action of the agent while it learns, see `q_learning`.
        power: the step size at the n-th visit is n ** -power, see `q_learning`.
        episode_steps: length of an episode.
        steps: increasing numbers of steps, after which the policies are evaluated.
    """

    worlds: Count = 20
    states: int = 12
    actions: Count = 3
    classes: Count = 4
    noise: Share = 0.2
    epsilon: Epsilon = 0.2
    power: Power = 0.6
    episode_steps: Count = 50
    steps: Sequence[int] = (100, 300, 1_000, 3_000, 10_000, 30_000)

    def __post_init__(self) -> None:
        if self.states < max(3, self.classes):
            raise ValueError(
                f"states={self.states} must be at least 3, and at least classes={self.classes}"
            )
        self.steps = tuple(self.steps)
        if not self.steps or list(self.steps) != sorted(set(self.steps)) or self.steps[0] < 1:
            raise ValueError(f"steps={list(self.steps)} must be increasing integers from 1")
        self.learn = partial(
            tabular.q_learning,
            epsilon=self.epsilon,
            power=self.power,
            episode_steps=self.episode_steps,
        )
        self.guides: Mapping[str, Callable[[tabular.MDP], Array]] = {
            "optimal": optimal_guide,
            f"noisy ({self.noise:.0%})": partial(noisy_guide, noise=self.noise),
            "random": random_guide,
            "worst": worst_guide,
        }

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        seeds = tqdm(range(self.worlds), unit="world", desc=stem.name, leave=False, mininterval=0.5)
        rows = [row for seed in seeds for row in self._world(seed)]
        write_csv(rows, stem.with_suffix(".csv"))
        scores = pd.DataFrame(rows)
        pairs = itertools.product(("state", "class"), self.guides)
        groups = [self._group(scores, view, guide) for view, guide in pairs]
        _draw(groups, self.steps, stem.with_suffix(".png"))
        table = markdown_table(groups, self._columns())
        reached, cases = sum(group["reached"] for group in groups), self.worlds * len(groups)
        ours = pages.certain_verdict(
            reached == cases, f"in {reached} of {cases} worlds, guides and views"
        )
        claims = [{"claim": "COIL ends at least as good as its guide, guaranteed", "ours": ours}]
        section = pages.claims_section(claims, {"ours": f"ours, {self.steps[-1]:,} steps"})
        notes = PAGES["tabular_coil"]["notes"].format(worlds=self.worlds)
        return f"## COIL at least as good as its guide\n\n{table}\n\n{notes}\n\n{section}"

    def _columns(self) -> dict[str, tuple[str, str]]:
        """Return heading and format of the columns of the table."""
        columns = {
            "view": ("agent observes", ""),
            "guide": ("guide", ""),
            "guide_score": ("guide's score", ".2f"),
            "coil_score": ("COIL", ".2f"),
            "plain_score": ("plain", ".2f"),
        }
        for n in reversed(self.steps[::-2]):  # every second one, or the table gets too wide
            columns[f"share_{n}"] = (f"≥ guide, {n:,} steps", ".0%")
        return columns | {
            "interval": ("95 %", ""),
            "nearly": (f"≥ guide - {NEARLY}", ".0%"),
            "plain_share": ("plain ≥ guide", ".0%"),
        }

    def _world(self, seed: int) -> Iterator[dict[str, Any]]:
        """Yield the scores in one world, a row for each view, guide and number of steps.

        A score is 0 for the value of the random policy and 1 for that of the optimal one.
        """
        rng = np.random.default_rng(seed)
        mdp = tabular.garnet(self.states, self.actions, rng)
        views = {
            "state": np.arange(self.states),
            "class": rng.permutation(self.states) % self.classes,
        }
        random = _value(mdp, random_guide(mdp))
        best = _value(mdp, tabular.value_iteration(mdp).policy)
        for view, observations in views.items():
            plain = self._learned_values(mdp, observations, seed)
            for name, guide in self.guides.items():
                policy = guide(mdp)
                advised = tabular.observations_with_advice(observations, self.actions)
                coil = self._learned_values(tabular.with_advice(mdp, policy), advised, seed)
                own = np.full(len(self.steps), _value(mdp, policy))
                scores = (np.stack([own, coil, plain], axis=1) - random) / (best - random)
                for n, (guide_score, coil_score, plain_score) in zip(
                    self.steps, scores.tolist(), strict=True
                ):
                    yield {
                        "view": view,
                        "guide": name,
                        "world": seed,
                        "steps": n,
                        "guide_score": guide_score,
                        "coil_score": coil_score,
                        "plain_score": plain_score,
                    }

    def _learned_values(self, mdp: tabular.MDP, observations: Integers, seed: int) -> Array:
        """Return the value of the greedy policy after each number of steps."""
        rng = np.random.default_rng(seed)
        learned = self.learn(
            mdp, self.steps[-1], rng, observations=observations, snapshots=self.steps
        )
        return np.array([_value(mdp, Q.argmax(axis=1)[observations]) for Q in learned.history])

    def _group(self, scores: pd.DataFrame, view: str, guide: str) -> dict[str, Any]:
        """Return shares and mean scores over all worlds, for one view and guide."""
        of_group = scores[(scores["view"] == view) & (scores["guide"] == guide)]
        own, coil, plain = (
            of_group[f"{name}_score"].to_numpy().reshape(self.worlds, len(self.steps))
            for name in ("guide", "coil", "plain")
        )
        reached = (coil >= own - ROUNDING).sum(axis=0)
        shares = reached / self.worlds
        interval = binomtest(int(reached[-1]), self.worlds).proportion_ci(method="wilson")
        return {
            "view": "the state" if view == "state" else f"one of {self.classes} classes",
            "guide": guide,
            "guide_score": own.mean(),
            "coil_score": coil[:, -1].mean(),
            "plain_score": plain[:, -1].mean(),
            **{f"share_{n}": share for n, share in zip(self.steps, shares, strict=True)},
            "interval": f"{interval.low:.0%} to {interval.high:.0%}",
            "nearly": (coil[:, -1] >= own[:, -1] - NEARLY).mean(),
            "plain_share": (plain >= own - ROUNDING).mean(axis=0)[-1],
            "reached": int(reached[-1]),
            "shares": shares,
            "coil_scores": coil.mean(axis=0),
            "plain_scores": plain.mean(axis=0),
        }


def _value(mdp: tabular.MDP, policy: Array | Integers) -> float:
    """Return the expected return of a policy from the start."""
    return float(mdp.start @ tabular.solve(mdp, policy))


def _draw(groups: Sequence[Mapping[str, Any]], steps: Sequence[int], path: Path) -> None:
    """Draw one column per view: shares above, scores below."""
    views = list(dict.fromkeys(group["view"] for group in groups))
    guides = list(dict.fromkeys(group["guide"] for group in groups))
    lines: dict[str, Any] = {
        name: {"color": colour, "lw": 2, "marker": "o", "ms": 4}
        for name, colour in zip(guides, style.AGENTS, strict=False)
    }
    handles = [Line2D([], [], label=f"COIL, guide {name}", **line) for name, line in lines.items()]
    handles.append(Line2D([], [], label="plain Q-learning", **PLAIN))
    handles.append(
        Line2D([], [], color=style.QUIET, lw=1.2, ls=style.DASHED, label="guide alone (its colour)")
    )
    with style.picture(path, "Tabular COIL and its guides", handles, height=5.6) as figure:
        grid = figure.subplots(2, len(views), sharex=True, sharey="row", squeeze=False)
        for (share, score), view in zip(grid.T, views, strict=True):
            of_view = [group for group in groups if group["view"] == view]
            for index, group in enumerate(of_view):
                line = lines[group["guide"]]
                shift = ScaledTranslation(
                    0, (index - 1.5) * LINE_OFFSET / 72, figure.dpi_scale_trans
                )
                share.plot(
                    steps, group["shares"], transform=share.transData + shift, clip_on=False, **line
                )
                _draw_scores(score, group, steps, line)
            score.plot(steps, of_view[0]["plain_scores"], **PLAIN)
            share.set_title(f"the agent observes {view}", size=9, loc="left", color=style.QUIET)
            score.set_xlabel("steps of experience")
        for axes in grid.flat:
            style.lighten(axes)
            axes.set_xscale("log")
            axes.set_xticks(steps, [f"{n:,}" for n in steps])
            axes.minorticks_off()
        grid[0, 0].set(ylabel="worlds where COIL\nis at least the guide", ylim=(0, 1))
        grid[0, 0].yaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
        grid[1, 0].set(ylabel="mean score\n(0 random, 1 optimal)", ylim=(LOWEST_SCORE, 1.05))


def _draw_scores(
    axes: Axes, group: Mapping[str, Any], steps: Sequence[int], line: Mapping[str, Any]
) -> None:
    """Draw the scores of COIL with one guide, and the score of the guide."""
    axes.plot(steps, group["coil_scores"], **line)
    axes.axhline(group["guide_score"], color=line["color"], lw=1.2, ls=style.DASHED, zorder=1.5)
    if group["guide_score"] < LOWEST_SCORE:
        axes.annotate(
            f"↓ guide {group['guide']} at {group['guide_score']:.2f}",
            (0, 0),
            (4, 4),
            color=line["color"],
            xycoords="axes fraction",
            textcoords="offset points",
        )
