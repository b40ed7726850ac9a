"""Tabular COIL: the guide's action becomes part of the state (equation 97).

The policy is pi(s, a_guide(s), a). The world in which the advice belongs to the state is again a
Markov decision process, so every method for Markov decision processes is COIL there, Q-learning
included.

Advice does not help an agent that observes the whole state: the best policy is as good without it.
Deterministic advice only renames the states, and random advice adds states to learn. Advice helps
an agent with fewer observations than the guide: following the guide becomes one of its policies, so
the best COIL policy is at least as good as the guide. There is no guarantee that Q-learning finds
it.
"""

import numpy as np
from numpy.typing import ArrayLike

from coil_paper.tabular.mdp import MDP, Array, Integers
from coil_paper.tabular.planning import value_iteration


def with_advice(mdp: MDP, guide: ArrayLike) -> MDP:
    """Return the world with the guide's advice in the state.

    Of the S * A states of the result, s * A + g is state s with the advice g.

    Args:
        mdp: the world without advice, with S states and A actions.
        guide: the guide's policy: actions [S], or their probabilities [S, A], of which one is drawn
            whenever a state is entered.

    Example:
        >>> from coil_paper.tabular import toymaker, with_advice
        >>> with_advice(toymaker(), [1, 1]).states[1]
        'successful toy, advised advertising'
    """
    advice = mdp.probabilities(guide)
    count, choices = mdp.P.shape[:2]
    # P[s, a, s'] of the world times the advice in s'; neither depends on the advice in s.
    P = np.einsum("sat,th->sath", mdp.P, advice).reshape(count, choices, count * choices)
    R = mdp.R.repeat(choices, axis=2)
    return MDP(
        P.repeat(choices, axis=0),
        R.repeat(choices, axis=0),
        mdp.gamma,
        start=(mdp.start[:, None] * advice).ravel(),
        states=[f"{state}, advised {action}" for state in mdp.states for action in mdp.actions],
        actions=mdp.actions,
    )


def observations_with_advice(observations: ArrayLike, actions: int) -> Integers:
    """Return what an agent with advice observes in each state of `with_advice`.

    Args:
        observations: [S] integers from 0, the observation of each state without advice.
        actions: A, the number of actions.

    Returns:
        [S * A], a different number for each pair of an observation and an advice.
    """
    return (np.asarray(observations)[:, None] * actions + np.arange(actions)).ravel()


def optimal_guide(mdp: MDP) -> Array:
    """Return an optimal policy, [S, A] probabilities."""
    return mdp.probabilities(value_iteration(mdp).policy)


def noisy_guide(mdp: MDP, noise: float = 0.5) -> Array:
    """Return an optimal policy that sometimes takes a random action, [S, A] probabilities.

    Args:
        noise: the probability of the random action, which is drawn uniformly from all actions.
    """
    return (1 - noise) * optimal_guide(mdp) + noise * random_guide(mdp)


def random_guide(mdp: MDP) -> Array:
    """Return the uniform policy, [S, A] probabilities."""
    return np.full_like(mdp.r, 1 / mdp.r.shape[1])


def worst_guide(mdp: MDP) -> Array:
    """Return the policy with the lowest value, [S, A] probabilities.

    It is the optimal policy for the negated rewards.
    """
    return optimal_guide(MDP(mdp.P, -mdp.R, mdp.gamma))
