"""COIL where everything fits into a table: the guide's action is one more part of the state (equation 97).

The agent's policy is pi(s, a_guide(s), a). So a world in which the advice belongs to the state is again a Markov
decision process, and every method for those is COIL there, Q-learning as it is.

What that can bring is plain to see here. An agent that sees the whole state knows as much without advice: the best
policy is as good with it as without. Advice from a guide that always says the same in the same state only gives states
another name, and advice that changes makes more of them to learn. It is of use to an agent that does not see all that
the guide sees. Then following it is a policy that such an agent has and would not have without, so that the best COIL
policy is at least as good as the guide. Nothing says that Q-learning finds it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from coil_rl.tabular.mdp import MDP, Array, Integers
from coil_rl.tabular.planning import value_iteration


def with_advice(mdp: MDP, guide: ArrayLike) -> MDP:
    """The world as an agent with a guide lives in it.

    Args:
        mdp: the world.
        guide: its policy, [S] actions or their probabilities [S, A]; then it draws each time a state is entered.

    Returns:
        A world with S * A states: s * A + g is state s, where the guide says g.

    Example:
        >>> from coil_rl.tabular import toymaker, with_advice
        >>> with_advice(toymaker(), [1, 1]).states[1]
        'successful toy, advised advertising'
    """
    says = mdp.probabilities(guide)
    count, choices = mdp.P.shape[:2]
    # P[s, a, s'] of the world, then what the guide says in s'; neither depends on what it said in s.
    P = np.einsum("sat,th->sath", mdp.P, says).reshape(count, choices, count * choices)
    R = mdp.R.repeat(choices, axis=2)
    return MDP(
        P.repeat(choices, axis=0),
        R.repeat(choices, axis=0),
        mdp.gamma,
        start=(mdp.start[:, None] * says).ravel(),
        states=[f"{state}, advised {action}" for state in mdp.states for action in mdp.actions],
        actions=mdp.actions,
    )


def sees_advice(sees: ArrayLike, choices: int) -> Integers:
    """What an agent sees of the states of `with_advice`, which saw `sees` [S] of those of the world without advice."""
    seen: Integers = (np.asarray(sees)[:, None] * choices + np.arange(choices)).ravel()
    return seen


def optimal_guide(mdp: MDP) -> Array:
    """[S, A]: an optimal policy."""
    return mdp.probabilities(value_iteration(mdp).policy)


def noisy_guide(mdp: MDP, noise: float = 0.5) -> Array:
    """[S, A]: an optimal policy, but with the probability `noise` any action."""
    return (1 - noise) * optimal_guide(mdp) + noise * random_guide(mdp)


def random_guide(mdp: MDP) -> Array:
    """[S, A]: all actions alike."""
    return np.full_like(mdp.r, 1 / mdp.r.shape[1])


def worst_guide(mdp: MDP) -> Array:
    """[S, A]: the policy that is worth least, which is optimal where all rewards are turned round."""
    return optimal_guide(MDP(mdp.P, -mdp.R, mdp.gamma))
