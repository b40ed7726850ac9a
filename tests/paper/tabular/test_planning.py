import itertools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coil_paper.tabular import (
    garnet,
    policy_evaluation,
    policy_iteration,
    solve,
    toymaker,
    value_iteration,
)

# The toymaker always advertises: V = r + gamma P V for that policy, by hand, with gamma = 19/20.
GAMMA = Fraction(19, 20)
DIFFERENCE = 9 / (1 - GAMMA / 10)
FIRST = (4 - GAMMA / 5 * DIFFERENCE) / (1 - GAMMA)
SECOND = FIRST - DIFFERENCE
EXACT = [
    [6 + GAMMA * (FIRST + SECOND) / 2, FIRST],
    [-3 + GAMMA * (2 * FIRST + 3 * SECOND) / 5, SECOND],
]

seeds = st.integers(0, 10_000)
FEW = settings(max_examples=20)


def world(seed, states=6, actions=3, gamma=0.9):
    return garnet(states, actions, np.random.default_rng(seed), gamma=gamma)


@pytest.mark.parametrize("method", [value_iteration, policy_iteration])
def test_values_of_the_toymaker_equal_the_solution_by_hand(method):
    plan = method(toymaker())
    assert plan.policy.tolist() == [1, 1]
    np.testing.assert_allclose(plan.Q, np.array(EXACT, dtype=float), rtol=0, atol=1e-8)
    np.testing.assert_allclose(plan.V, [float(FIRST), float(SECOND)], rtol=0, atol=1e-8)


@FEW
@given(seeds)
def test_value_and_policy_iteration_find_the_best_of_all_policies(seed):
    mdp = world(seed, states=4, actions=2)
    policies = itertools.product(range(2), repeat=4)
    best = np.max([solve(mdp, np.array(policy)) for policy in policies], axis=0)
    for method in (value_iteration, policy_iteration):
        plan = method(mdp)
        np.testing.assert_allclose(plan.V, best, rtol=0, atol=1e-8)
        np.testing.assert_allclose(solve(mdp, plan.policy), best, rtol=0, atol=1e-8)


@given(seeds, st.floats(0, 0.99))
def test_policy_evaluation_solves_the_linear_equations(seed, gamma):
    mdp, rng = world(seed, gamma=gamma), np.random.default_rng(seed)
    policy = rng.dirichlet(np.ones(3), size=6)
    found = policy_evaluation(mdp, policy, 1e-7)
    np.testing.assert_allclose(found, solve(mdp, policy), rtol=0, atol=1e-7)


def test_iteration_ends_when_actions_are_tied_and_at_any_tolerance():
    mdp = world(0)
    mdp.P[:, 1], mdp.r[:, 1] = mdp.P[:, 0], mdp.r[:, 0]
    for first in range(3):
        found = policy_iteration(mdp, np.full(6, first)).V
        np.testing.assert_allclose(found, value_iteration(mdp).V, atol=1e-8)
    assert np.abs(value_iteration(toymaker(0.99), 1e-300).V).max() < 1e6
    with pytest.raises(ValueError, match="tolerance=0 must be more than 0"):
        value_iteration(toymaker(), 0)
