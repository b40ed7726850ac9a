"""A model learned by counting: what was lived through stands for the world (paper equations 50 and 51)."""

from __future__ import annotations

import numpy as np

from coil_rl.tabular.mdp import MDP, Array
from coil_rl.tabular.simulator import Experience


class ModelEstimate:
    """Estimates P and R of a Markov decision process from transitions.

    Args:
        states: S.
        actions: A.

    Attributes:
        counts: [S, A, S], how often each transition was seen.
        rewards: [S, A, S], the sum of their rewards.

    Example:
        >>> import numpy as np
        >>> from coil_rl.tabular import ModelEstimate, experience, toymaker, value_iteration
        >>> world, at_random = toymaker(), np.full((2, 2), 0.5)
        >>> model = ModelEstimate(2, 2)
        >>> model.add(experience(world, at_random, 2_000, np.random.default_rng(0)))
        >>> value_iteration(model.mdp(world.gamma)).policy.tolist()
        [1, 1]
    """

    def __init__(self, states: int, actions: int) -> None:
        self.counts: Array = np.zeros((states, actions, states))
        self.rewards: Array = np.zeros((states, actions, states))

    def add(self, seen: Experience) -> None:
        """Count more transitions."""
        where = (seen.state, seen.action, seen.following)
        np.add.at(self.counts, where, 1)
        np.add.at(self.rewards, where, seen.reward)

    @property
    def P(self) -> Array:  # noqa: N802
        """[S, A, S]: N(s, a, s') / N(s, a), the share of each next state (equation 50); NaN where nothing was seen."""
        tried = self.counts.sum(axis=2, keepdims=True)
        return np.divide(self.counts, tried, out=np.full_like(self.counts, np.nan), where=tried > 0)

    @property
    def R(self) -> Array:  # noqa: N802
        """[S, A, S]: the mean reward of each transition (equation 51); 0 for one that was never seen."""
        return np.divide(self.rewards, self.counts, out=np.zeros_like(self.rewards), where=self.counts > 0)

    def mdp(self, gamma: float) -> MDP:
        """What is known as a world of its own, on which to plan.

        Raises:
            ValueError: if an action was never tried in a state, naming one: nothing can be planned on that.
        """
        untried = np.argwhere(self.counts.sum(axis=2) == 0)
        if len(untried):
            state, action = untried[0]
            raise ValueError(
                f"action {action} was never tried in state {state}, nor {len(untried) - 1} other pairs; "
                "add experience of a policy that tries all"
            )
        return MDP(self.P, self.R, gamma)
