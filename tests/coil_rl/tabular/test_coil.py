import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coil_rl.tabular import garnet, policy_iteration, q_learning, sees_advice, solve, toymaker, with_advice
from coil_rl.tabular.coil import noisy_guide, optimal_guide, random_guide, worst_guide

S, A = 5, 3
FEW = settings(max_examples=20)
seeds = st.integers(0, 10_000)
FOLLOW = np.tile(np.arange(A), S)  # in state s * A + g, do g


def world(seed):
    """A world, and a guide that draws what it says."""
    rng = np.random.default_rng(seed)
    return garnet(S, A, rng), rng.dirichlet(np.ones(A), size=S)


@FEW
@given(seeds)
def test_who_follows_the_advice_is_worth_what_the_guide_is(seed):
    mdp, guide = world(seed)
    advised = with_advice(mdp, guide)
    assert advised.start @ solve(advised, FOLLOW) == pytest.approx(mdp.start @ solve(mdp, guide))


@FEW
@given(seeds)
def test_who_sees_the_state_is_worth_as_much_at_best_whatever_the_advice(seed):
    mdp, guide = world(seed)
    best = policy_iteration(with_advice(mdp, guide))
    np.testing.assert_allclose(best.V.reshape(S, A), np.tile(policy_iteration(mdp).V[:, None], A), atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_advice_that_is_always_the_same_in_a_state_changes_nothing_that_q_learning_does(seed):
    mdp, _ = world(seed)
    guide = np.random.default_rng(seed).integers(A, size=S)
    plain, coil = (
        q_learning(each, 2_000, np.random.default_rng(seed), episode=20) for each in (mdp, with_advice(mdp, guide))
    )
    said = np.arange(S) * A + guide
    np.testing.assert_array_equal(coil.Q[said], plain.Q)
    assert coil.visits.sum() == coil.visits[said].sum()


def test_an_agent_that_cannot_tell_states_apart_does_better_with_an_optimal_guide():
    """Blind but for the advice: Q-learning finds out that following it is best."""
    mdp = garnet(S, A, np.random.default_rng(1))
    blind, guide = np.zeros(S, dtype=np.int64), optimal_guide(mdp)
    advised, sees = with_advice(mdp, guide), sees_advice(blind, A)
    learned = q_learning(advised, 20_000, np.random.default_rng(0), epsilon=0.3, episode=20, sees=sees)
    coil = advised.start @ solve(advised, learned.policy[sees])
    alone = max(mdp.start @ solve(mdp, np.full(S, action)) for action in range(A))
    assert coil == pytest.approx(mdp.start @ policy_iteration(mdp).V)
    assert coil > alone


def test_what_is_seen_with_advice_keeps_apart_what_was_apart_and_what_is_said():
    assert sees_advice([1, 0, 1], 2).tolist() == [2, 3, 0, 1, 2, 3]


@FEW
@given(seeds)
def test_guides_are_as_good_as_their_names(seed):
    mdp, any_policy = world(seed)
    worth = [solve(mdp, guide(mdp)) for guide in (optimal_guide, worst_guide)]
    among = solve(mdp, any_policy)
    assert (worth[0] >= among - 1e-8).all()
    assert (worth[1] <= among + 1e-8).all()
    np.testing.assert_allclose(noisy_guide(mdp, 0), optimal_guide(mdp))
    np.testing.assert_allclose(noisy_guide(mdp, 1), random_guide(mdp))


def test_states_are_named_after_what_is_advised():
    assert with_advice(toymaker(), [1, 1]).states[0] == "successful toy, advised no advertising"
