"""Optimal control of a known Markov decision process by dynamic programming (paper algorithms 1 to 3).

All three repeat one thing, the Bellman equation read as an assignment, V <- r + gamma P V. Each repetition brings V
nearer to the one V that stays as it is, by the factor gamma at least.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from coil_rl.tabular.mdp import MDP, Array, Integers

TIE = 1e-9  # an action must be better by more than rounding to take another's place


@dataclass(frozen=True)
class Plan:
    """What a planner found.

    Attributes:
        policy: [S], the action to take in each state.
        V: [S], what each state is then worth.
        Q: [S, A], what each action is worth, if the policy acts afterwards.
        history: [K + 1, S], V before and after each of the K iterations.
    """

    policy: Integers
    V: Array
    Q: Array
    history: Array


def policy_evaluation(mdp: MDP, policy: ArrayLike, tolerance: float = 1e-9) -> Array:
    """V [S] of a policy, by iteration from 0 (algorithm 1).

    Args:
        mdp: the world.
        policy: [S] actions, or their probabilities [S, A].
        tolerance: largest error of V.

    Raises:
        ValueError: if it is no policy of this world, or the tolerance is not more than 0.
    """
    pi = mdp.probabilities(policy)
    V = np.zeros(len(mdp.states))
    while True:
        before, V = V, (pi * mdp.q(V)).sum(axis=1)
        if _near_enough(mdp, V, before, tolerance):
            return V


def solve(mdp: MDP, policy: ArrayLike) -> Array:
    """V [S] of a policy as the solution of the linear equations V = r + gamma P V, without iteration.

    Args:
        mdp: the world.
        policy: [S] actions, or their probabilities [S, A].
    """
    pi = mdp.probabilities(policy)
    P, r = np.einsum("sa,sat->st", pi, mdp.P), (pi * mdp.r).sum(axis=1)
    return np.linalg.solve(np.eye(len(r)) - mdp.gamma * P, r)


def policy_iteration(mdp: MDP, policy: ArrayLike | None = None, tolerance: float = 1e-12) -> Plan:
    """Evaluate the policy, act greedily on what was found, and so on until that changes nothing (algorithm 2).

    Args:
        mdp: the world.
        policy: [S] actions to begin with; the first action everywhere if it is not given.
        tolerance: of each evaluation.

    Returns:
        An optimal policy; `history` has the V of each policy on the way.
    """
    count = len(mdp.states)
    policy = np.zeros(count, dtype=np.int64) if policy is None else np.asarray(policy, dtype=np.int64)
    history = []
    while True:
        V = policy_evaluation(mdp, policy, tolerance)
        history.append(V)
        Q = mdp.q(V)
        # Of actions that are worth the same the present one stays, or two optimal policies could alternate for ever.
        improves = Q.max(axis=1) > Q[np.arange(count), policy] + TIE
        if not improves.any():
            return Plan(policy, V, Q, np.array(history))
        policy = np.where(improves, Q.argmax(axis=1), policy)


def value_iteration(mdp: MDP, tolerance: float = 1e-9) -> Plan:
    """V <- the largest of r + gamma P V over the actions, until it settles, from 0 (algorithm 3).

    Args:
        mdp: the world.
        tolerance: largest error of V.

    Returns:
        An optimal policy; `history` has V after each iteration.

    Raises:
        ValueError: if the tolerance is not more than 0.
    """
    history = [np.zeros(len(mdp.states))]
    while True:
        V = mdp.q(history[-1]).max(axis=1)
        history.append(V)
        if _near_enough(mdp, V, history[-2], tolerance):
            Q = mdp.q(V)
            return Plan(Q.argmax(axis=1), V, Q, np.array(history))


def _near_enough(mdp: MDP, V: Array, before: Array, tolerance: float) -> bool:
    """Whether V is certainly no further than the tolerance from its limit: what is still to come is a geometric sum."""
    if not tolerance > 0:
        raise ValueError(f"tolerance={tolerance} must be more than 0, or the iteration would never end")
    # Nor can it come nearer than numbers of this size can be told apart.
    rounding = 4 * np.finfo(np.float64).eps * max(1.0, float(np.abs(V).max()))
    left = mdp.gamma / (1 - mdp.gamma) * float(np.abs(V - before).max())
    return left <= max(tolerance, rounding / (1 - mdp.gamma))
