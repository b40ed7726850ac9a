"""Example Markov decision processes: the toymaker and random worlds."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from coil_rl.tabular.mdp import MDP


def toymaker(gamma: float = 0.95) -> MDP:
    """Return Howard's toymaker (1960), the paper's first example, small enough to solve by hand.

    The toy is successful or not, and the toymaker advertises or not. Advertising costs reward now and makes a
    successful toy more likely.

    Args:
        gamma: discount factor; below 20/29, about 0.69, advertising does not pay.
    """
    P = [[[0.5, 0.5], [0.8, 0.2]], [[0.4, 0.6], [0.7, 0.3]]]
    R = [[[9.0, 3.0], [4.0, 4.0]], [[3.0, -7.0], [1.0, -19.0]]]
    return MDP(P, R, gamma, states=("successful toy", "unsuccessful toy"), actions=("no advertising", "advertising"))


def garnet(states: int, actions: int, rng: Generator, *, branches: int = 3, gamma: float = 0.9) -> MDP:
    """Return a random world (a Garnet, Archibald et al. 1995).

    Each action leads to a few randomly drawn states, with probabilities from a flat Dirichlet distribution and a
    normally distributed reward that does not depend on the next state.

    Args:
        states: S.
        actions: A.
        rng: random generator.
        branches: number of possible next states of an action, from 1 to S.
        gamma: discount factor.

    Raises:
        ValueError: if `branches` is out of range.
    """
    if not 1 <= branches <= states:
        raise ValueError(f"branches={branches} must be between 1 and states={states}")
    P = np.zeros((states, actions, states))
    for s in range(states):
        for a in range(actions):
            P[s, a, rng.choice(states, branches, replace=False)] = rng.dirichlet(np.ones(branches))
    R = np.broadcast_to(rng.normal(size=(states, actions, 1)), P.shape)
    return MDP(P, R, gamma)
