"""Random worlds on which claims about all Markov decision processes are tried out."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from coil_rl.tabular.mdp import MDP


def garnet(states: int, actions: int, rng: Generator, *, branches: int = 3, gamma: float = 0.9) -> MDP:
    """A random world (a Garnet, after Archibald et al. 1995).

    Each action leads from each state to a few states drawn at random, with probabilities that split the unit interval
    at random, and pays a normally distributed amount wherever it leads.

    Args:
        states: S.
        actions: A.
        rng: of everything in it.
        branches: how many states an action may lead to, from 1 to S.
        gamma: discount factor.

    Raises:
        ValueError: for so many branches.
    """
    if not 1 <= branches <= states:
        raise ValueError(f"branches={branches} must be between 1 and states={states}")
    P = np.zeros((states, actions, states))
    for s in range(states):
        for a in range(actions):
            P[s, a, rng.choice(states, branches, replace=False)] = rng.dirichlet(np.ones(branches))
    R = np.broadcast_to(rng.normal(size=(states, actions, 1)), P.shape)
    return MDP(P, R, gamma)
