"""Dynamic programming: optimal control of a known Markov decision process (algorithms 1 to 3).

All three algorithms of the paper iterate the Bellman equation as an assignment,
V <- r + gamma P V, which is a contraction with factor gamma.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from coil_paper.tabular.mdp import MDP, Array, Integers
from coil_rl.ranges import Positive, checked

TIE = 1e-9  # smaller differences of Q are rounding


@dataclass(frozen=True)
class PlanningResult:
    """An optimal policy and its values.

    Attributes:
        policy: [S], the action in each state.
        V: [S], the value of each state.
        Q: [S, A], the value of each action, followed by the policy.
        history: [K + 1, S], V before and after each of the K iterations.
    """

    policy: Integers
    V: Array
    Q: Array
    history: Array


@checked
def policy_evaluation(mdp: MDP, policy: ArrayLike, tolerance: Positive = 1e-9) -> Array:
    """Return the value of each state under a policy, by iteration from 0 (algorithm 1).

    Args:
        policy: actions [S], or their probabilities [S, A].
        tolerance: the largest error of V.

    Returns:
        V, [S].
    """
    pi = mdp.probabilities(policy)
    V = np.zeros(len(mdp.states))
    while True:
        previous, V = V, (pi * mdp.q(V)).sum(axis=1)
        if _converged(mdp, V, previous, tolerance):
            return V


def solve(mdp: MDP, policy: ArrayLike) -> Array:
    """Return the value of each state under a policy, by solving V = r + gamma P V.

    The equations are linear in V, so this needs no iteration.

    Args:
        policy: actions [S], or their probabilities [S, A].

    Returns:
        V, [S].
    """
    pi = mdp.probabilities(policy)
    P, r = np.einsum("sa,sat->st", pi, mdp.P), (pi * mdp.r).sum(axis=1)
    return np.linalg.solve(np.eye(len(r)) - mdp.gamma * P, r)


@checked
def policy_iteration(
    mdp: MDP, policy: ArrayLike | None = None, tolerance: Positive = 1e-12
) -> PlanningResult:
    """Alternate policy evaluation and greedy improvement until the policy is stable (algorithm 2).

    Args:
        policy: actions [S] to begin with; by default the first action everywhere.
        tolerance: the largest error of V in each policy evaluation.

    Returns:
        The optimal policy; its `history` has V of each intermediate policy.
    """
    count = len(mdp.states)
    if policy is None:
        policy = np.zeros(count, dtype=np.int64)
    else:
        policy = np.asarray(policy, dtype=np.int64)
    history = []
    while True:
        V = policy_evaluation(mdp, policy, tolerance)
        history.append(V)
        Q = mdp.q(V)
        # Keep the present action on a tie, or two optimal policies could alternate endlessly.
        improves = Q.max(axis=1) > Q[np.arange(count), policy] + TIE
        if not improves.any():
            return PlanningResult(policy, V, Q, np.array(history))
        policy = np.where(improves, Q.argmax(axis=1), policy)


@checked
def value_iteration(mdp: MDP, tolerance: Positive = 1e-9) -> PlanningResult:
    """Iterate V <- max over actions of r + gamma P V from 0 until convergence (algorithm 3).

    Args:
        tolerance: the largest error of V.

    Returns:
        The optimal policy; its `history` has V after each iteration.
    """
    history = [np.zeros(len(mdp.states))]
    while True:
        V = mdp.q(history[-1]).max(axis=1)
        history.append(V)
        if _converged(mdp, V, history[-2], tolerance):
            Q = mdp.q(V)
            return PlanningResult(Q.argmax(axis=1), V, Q, np.array(history))


def _converged(mdp: MDP, V: Array, previous: Array, tolerance: float) -> bool:
    """Return whether V is within the tolerance of its limit.

    The change of an iteration bounds the sum of all later changes, which is a geometric series.
    """
    # Rounding limits what can be reached.
    rounding = 4 * np.finfo(np.float64).eps * max(1.0, float(np.abs(V).max()))
    remaining = mdp.gamma / (1 - mdp.gamma) * float(np.abs(V - previous).max())
    return remaining <= max(tolerance, rounding / (1 - mdp.gamma))
