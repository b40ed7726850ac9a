"""COIL is "at least as good as its guide" (paper 3.2): how often that holds after how much experience.

Q-learning with a guide's advice, on random worlds small enough that what its policy is worth is computed and not
estimated, so that "at least as good" is a yes or a no. Beside it Q-learning of the same experience without advice. The
agents see the state, or only which of a few kinds it is of; the guide knows the state either way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest
from tqdm import tqdm

from coil_rl.report import markdown_table, write_csv
from coil_rl.reproduce.result import NO_RUNS, Result, Runs
from coil_rl.reproduce.tabular_coil_picture import draw
from coil_rl.reproduce.verdict import FAILED, HEADING, HELD
from coil_rl.tabular import MDP, garnet, q_learning, solve, value_iteration
from coil_rl.tabular.coil import noisy_guide, optimal_guide, random_guide, sees_advice, with_advice, worst_guide
from coil_rl.tabular.mdp import Array, Integers

NEARLY = 0.01  # of a score
EQUAL = 1e-9  # scores may differ by rounding where policies are the same

NOTES = """
Scores: 0 for acting at random, 1 for the optimal policy, each world's own; means over {worlds} random worlds, one seed
each, after the last step. ≥ guide: in how many of them the greedy policy is worth at least as much as the guide's,
exactly, with the 95 % (Wilson) interval of the last share. The paper: at least as good as the guide, guaranteed, which
would be 100 %. Plain: Q-learning without advice."""


class TabularCoil(Result):
    """Tabular COIL against guides of several qualities.

    Args:
        worlds: how many; world k has the seed k, for what it is and for what happens in it.
        states: of each world.
        actions: of each world.
        kinds: of states, where the agent cannot tell those of one kind apart.
        noise: probability of the noisy guide to say anything.
        epsilon: see `q_learning`.
        power: see `q_learning`.
        episode: steps of an episode.
        steps: of experience, after which the policies are judged.
    """

    def __init__(
        self,
        worlds: int = 20,
        states: int = 12,
        actions: int = 3,
        kinds: int = 4,
        noise: float = 0.2,
        epsilon: float = 0.2,
        power: float = 0.6,
        episode: int = 50,
        steps: Sequence[int] = (100, 300, 1_000, 3_000, 10_000, 30_000),
    ) -> None:
        for name, value in {"worlds": worlds, "actions": actions, "kinds": kinds, "episode": episode}.items():
            if value < 1:
                raise ValueError(f"{name}={value} must be at least 1")
        if states < max(3, kinds):
            raise ValueError(f"states={states} must be at least 3, and as many as there are kinds")
        if not 0 <= noise <= 1 or not 0 < epsilon <= 1 or not 0.5 < power <= 1:
            raise ValueError(
                f"noise={noise} must be between 0 and 1, epsilon={epsilon} more than 0 and at most 1, "
                f"and power={power} more than 0.5 and at most 1"
            )
        if not steps or list(steps) != sorted(set(steps)) or steps[0] < 1:
            raise ValueError(f"steps={list(steps)} must be whole numbers from 1 that grow")
        self.worlds, self.states, self.actions, self.kinds = worlds, states, actions, kinds
        self.learn = partial(q_learning, epsilon=epsilon, power=power, episode=episode, snapshots=steps)
        self.steps = tuple(steps)
        self.guides: Mapping[str, Callable[[MDP], Array]] = {
            "optimal": optimal_guide,
            f"noisy ({noise:.0%})": partial(noisy_guide, noise=noise),
            "random": random_guide,
            "worst": worst_guide,
        }

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        seeds = tqdm(range(self.worlds), unit="world", desc=stem.name, leave=False, mininterval=0.5)
        rows = [row for seed in seeds for row in self._world(seed)]
        write_csv(rows, stem.with_suffix(".csv"))
        groups = [self._group(rows, sees, guide) for sees in ("all", "kinds") for guide in self.guides]
        draw(groups, self.steps, stem.with_suffix(".png"))
        share = {f"share_{n}": (f"≥ guide, {n:,} steps", ".0%") for n in self.steps[-1::-2][::-1]}
        columns = {
            "sees": ("agent sees", ""), "guide": ("guide", ""), "guide_score": ("guide's score", ".2f"),
            "coil_score": ("COIL", ".2f"), "plain_score": ("plain", ".2f"),
            **share, "interval": ("95 %", ""), "nearly": (f"≥ guide - {NEARLY}", ".0%"),
            "plain_share": ("plain ≥ guide", ".0%"),
        }  # fmt: skip
        table = markdown_table(groups, columns)
        reached, cases = sum(group["reached"] for group in groups), self.worlds * len(groups)
        ours = f"**{HELD if reached == cases else FAILED}**: in {reached} of {cases} worlds, guides and views"
        held = [{"claim": "COIL ends at least as good as its guide, guaranteed", "ours": ours}]
        end = markdown_table(held, {"claim": ("the paper says", ""), "ours": (f"ours, {self.steps[-1]:,} steps", "")})
        notes = NOTES.format(worlds=self.worlds)
        return f"## COIL at least as good as its guide\n\n{table}\n{notes}\n\n{HEADING}\n\n{end}"

    def _world(self, seed: int) -> Iterator[dict[str, Any]]:
        """What happened in one world: a row for what is seen, guide and number of steps."""
        rng = np.random.default_rng(seed)
        mdp = garnet(self.states, self.actions, rng)
        views = {"all": np.arange(self.states), "kinds": rng.permutation(self.states) % self.kinds}
        worst, best = _worth(mdp, random_guide(mdp)), _worth(mdp, value_iteration(mdp).policy)
        for view, sees in views.items():
            plain = self._worths(mdp, sees, seed)
            for name, guide in self.guides.items():
                says = guide(mdp)
                coil = self._worths(with_advice(mdp, says), sees_advice(sees, self.actions), seed)
                own = np.full(len(self.steps), _worth(mdp, says))
                scores = (np.stack([own, coil, plain], axis=1) - worst) / (best - worst)
                for n, of_each in zip(self.steps, scores, strict=True):
                    found = dict(zip(("guide_score", "coil_score", "plain_score"), of_each.tolist(), strict=True))
                    yield {"sees": view, "guide": name, "world": seed, "steps": n} | found

    def _worths(self, mdp: MDP, sees: Integers, seed: int) -> Array:
        """What the greedy policies of Q-learning are worth, one for each number of steps."""
        learned = self.learn(mdp, self.steps[-1], np.random.default_rng(seed), sees=sees)
        return np.array([_worth(mdp, Q.argmax(axis=1)[sees]) for Q in learned.history])

    def _group(self, rows: Sequence[Mapping[str, Any]], sees: str, guide: str) -> dict[str, Any]:
        """The worlds together: shares after each number of steps, mean scores after the last."""
        own, coil, plain = (
            np.array([row[key] for row in rows if row["sees"] == sees and row["guide"] == guide]).reshape(
                self.worlds, len(self.steps)
            )
            for key in ("guide_score", "coil_score", "plain_score")
        )
        reached = (coil >= own - EQUAL).sum(axis=0)
        interval = binomtest(int(reached[-1]), self.worlds).proportion_ci(method="wilson")
        return {
            "sees": "the state" if sees == "all" else f"one of {self.kinds} kinds",
            "guide": guide,
            "guide_score": own.mean(),
            "coil_score": coil[:, -1].mean(),
            "plain_score": plain[:, -1].mean(),
            **{f"share_{n}": count / self.worlds for n, count in zip(self.steps, reached, strict=True)},
            "interval": f"{interval.low:.0%} to {interval.high:.0%}",
            "nearly": (coil[:, -1] >= own[:, -1] - NEARLY).mean(),
            "plain_share": (plain >= own - EQUAL).mean(axis=0)[-1],
            "shares": reached / self.worlds,
            "reached": int(reached[-1]),
            "coil_scores": coil.mean(axis=0),
            "plain_scores": plain.mean(axis=0),
        }


def _worth(mdp: MDP, policy: Array | Integers) -> float:
    """The mean return of a policy."""
    return float(mdp.start @ solve(mdp, policy))
