import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coil_paper.tabular import (
    garnet,
    observations_with_advice,
    policy_iteration,
    q_learning,
    solve,
    toymaker,
    with_advice,
)
from coil_paper.tabular.coil import optimal_guide

S, A = 5, 3
FEW = settings(max_examples=20)
seeds = st.integers(0, 10_000)
FOLLOW = np.tile(np.arange(A), S)  # action g in state s * A + g


def world(seed):
    """A random world and a random stochastic guide."""
    rng = np.random.default_rng(seed)
    return garnet(S, A, rng), rng.dirichlet(np.ones(A), size=S)


@FEW
@given(seeds)
def test_following_the_advice_has_the_guides_value(seed):
    mdp, guide = world(seed)
    advised = with_advice(mdp, guide)
    assert advised.start @ solve(advised, FOLLOW) == pytest.approx(mdp.start @ solve(mdp, guide))


@FEW
@given(seeds)
def test_advice_does_not_change_the_optimal_value(seed):
    mdp, guide = world(seed)
    advised, alone = (policy_iteration(each).V for each in (with_advice(mdp, guide), mdp))
    np.testing.assert_allclose(advised.reshape(S, A), np.tile(alone[:, None], A), atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_deterministic_advice_does_not_change_q_learning(seed):
    mdp, _ = world(seed)
    guide = np.random.default_rng(seed).integers(A, size=S)
    plain, coil = (
        q_learning(each, 2_000, np.random.default_rng(seed), episode_steps=20)
        for each in (mdp, with_advice(mdp, guide))
    )
    advised = np.arange(S) * A + guide
    np.testing.assert_array_equal(coil.Q[advised], plain.Q)
    assert not np.delete(coil.Q, advised, axis=0).any()  # never visited


def test_optimal_advice_helps_an_agent_without_observations():
    mdp = garnet(S, A, np.random.default_rng(1))
    blind, guide = np.zeros(S, dtype=np.int64), optimal_guide(mdp)
    advised, observations = with_advice(mdp, guide), observations_with_advice(blind, A)
    rng, options = np.random.default_rng(0), {"epsilon": 0.3, "episode_steps": 20}
    learned = q_learning(advised, 20_000, rng, observations=observations, **options)
    coil = advised.start @ solve(advised, learned.policy[observations])
    alone = max(mdp.start @ solve(mdp, np.full(S, action)) for action in range(A))
    assert coil == pytest.approx(mdp.start @ policy_iteration(mdp).V)
    assert coil > alone
    assert observations_with_advice([1, 0, 1], 2).tolist() == [2, 3, 0, 1, 2, 3]
    assert with_advice(toymaker(), [1, 1]).states[0] == "successful toy, advised no advertising"
