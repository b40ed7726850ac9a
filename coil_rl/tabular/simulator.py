"""A Markov decision process that happens: one state after the other, as an agent lives through it."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from coil_rl.tabular.mdp import MDP, Array, Integers


class Simulator:
    """Plays a Markov decision process.

    Args:
        mdp: the world.
        rng: of all that is left to chance.
        episode: steps after which it begins anew, as it does after a terminal state; None for never.

    Attributes:
        state: where it is.
    """

    def __init__(self, mdp: MDP, rng: Generator, episode: int | None = None) -> None:
        if episode is not None and episode < 1:
            raise ValueError(f"episode={episode} must be at least one step, or None")
        self.rng, self.episode = rng, episode
        # Plain lists: one number at a time they are several times faster than arrays.
        self._next, self._rewards = _cumulative(mdp.P).tolist(), mdp.R.tolist()
        self._start, self._terminal = _cumulative(mdp.start).tolist(), mdp.terminal.tolist()
        self.begin()

    def begin(self) -> None:
        """Begin anew in one of the states of `start`."""
        self.state, self.steps = bisect_right(self._start, self.rng.random()), 0

    def step(self, action: int) -> tuple[float, int]:
        """Take an action.

        Returns:
            The reward, and the state it led to; `state` is that one too, unless a new episode has begun.
        """
        following = bisect_right(self._next[self.state][action], self.rng.random())
        reward = self._rewards[self.state][action][following]
        self.state, self.steps = following, self.steps + 1
        if self._terminal[following] or self.steps == self.episode:
            self.begin()
        return reward, following


@dataclass(frozen=True)
class Experience:
    """Transitions, one an entry of each array [N].

    Attributes:
        state: where the action was taken.
        action: that was taken.
        reward: for it.
        following: the state it led to.
    """

    state: Integers
    action: Integers
    reward: Array
    following: Integers


def experience(mdp: MDP, policy: ArrayLike, steps: int, rng: Generator, episode: int | None = None) -> Experience:
    """What a policy lives through.

    Args:
        mdp: the world.
        policy: [S] actions, or their probabilities [S, A].
        steps: N.
        rng: of all that is left to chance.
        episode: see `Simulator`.
    """
    choices = _cumulative(mdp.probabilities(policy)).tolist()
    world = Simulator(mdp, rng, episode)
    whole, real = np.zeros((3, steps), dtype=np.int64), np.zeros(steps)
    seen = Experience(state=whole[0], action=whole[1], reward=real, following=whole[2])
    for n in range(steps):
        seen.state[n] = state = world.state
        seen.action[n] = action = bisect_right(choices[state], rng.random())
        seen.reward[n], seen.following[n] = world.step(action)
    return seen


def _cumulative(probabilities: Array) -> Array:
    """Along the last axis; ends at exactly 1, so that a draw below 1 never finds what has probability 0."""
    total = probabilities.cumsum(axis=-1)
    ending: Array = total / total[..., -1:]
    return ending
