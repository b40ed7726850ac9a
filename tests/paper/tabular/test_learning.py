import numpy as np
import pytest
from scipy.stats import chisquare

from coil_paper.tabular import (
    MDP,
    ModelEstimate,
    Simulator,
    Transitions,
    garnet,
    policy_iteration,
    q_learning,
    sample_transitions,
    solve,
    toymaker,
    value_iteration,
)

UNIFORM = np.full((5, 2), 0.5)


def corridor(length, gamma=0.9):
    """Return a row of states from the start on the left to a terminal one with a reward of 2."""
    P, R = np.zeros((length, 2, length)), np.zeros((length, 2, length))
    for s in range(length):
        P[s, 0, max(s - 1, 0)] = P[s, 1, min(s + 1, length - 1)] = 1
    P[-1] = np.eye(length)[-1]
    R[-2, 1, -1] = 2
    return MDP(P, R, gamma, start=np.eye(length)[0])


def learn(mdp, seed=0, steps=20_000, **options):
    return q_learning(mdp, steps, np.random.default_rng(seed), **({"epsilon": 0.3} | options))


def test_transition_frequencies_match_the_probabilities():
    mdp = garnet(5, 2, np.random.default_rng(1))
    sample = sample_transitions(mdp, UNIFORM, 20_000, np.random.default_rng(0))
    for s, a in np.ndindex(5, 2):
        next_states = sample.next_state[(sample.state == s) & (sample.action == a)]
        counts, possible = np.bincount(next_states, minlength=5), mdp.P[s, a] > 0
        assert counts[~possible].sum() == 0
        expected = mdp.P[s, a, possible] / mdp.P[s, a, possible].sum() * len(next_states)
        assert chisquare(counts[possible], expected).pvalue > 1e-4
    rewards = mdp.R[sample.state, sample.action, sample.next_state]
    np.testing.assert_array_equal(sample.reward, rewards)
    np.testing.assert_array_equal(sample.next_state[:-1], sample.state[1:])


def test_transitions_and_q_depend_on_the_seed_only():
    mdp = garnet(5, 2, np.random.default_rng(1))
    first, again, other = (
        sample_transitions(mdp, UNIFORM, 100, np.random.default_rng(seed)) for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first.state, again.state)
    assert (first.state != other.state).any()
    values = [learn(mdp, seed, 500).Q for seed in (1, 1, 2)]
    np.testing.assert_array_equal(values[0], values[1])
    assert (values[0] != values[2]).any()


def test_an_episode_ends_at_a_terminal_state_or_after_its_steps():
    world, right = corridor(3), np.full(3, 1)
    rng = np.random.default_rng(0)
    assert sample_transitions(world, right, 6, rng).state.tolist() == [0, 1] * 3
    assert sample_transitions(world, right, 3, rng, episode_steps=1).state.tolist() == [0] * 3
    with pytest.raises(ValueError, match="episode_steps=0 must be at least 1"):
        Simulator(world, np.random.default_rng(0), episode_steps=0)


def test_rounded_probabilities_never_lead_to_impossible_states():
    P = np.zeros((11, 1, 11))
    P[:, 0, :10] = 0.1  # sums to 0.9999999999999999

    class LargestDraw:
        def random(self):
            return np.nextafter(1, 0)

    world = Simulator(MDP(P, np.ones_like(P), 0.9, start=P[0, 0]), LargestDraw())
    assert world.state == 9
    assert world.step(0) == (1.0, 9)


def test_a_model_estimate_has_relative_frequencies_and_mean_rewards():
    model = ModelEstimate(2, 2)
    steps = [(0, 1, 1.0, 0), (0, 1, 2.0, 1), (0, 1, 3.0, 1), (0, 1, 7.0, 1), (1, 0, 5.0, 0)]
    state, action, reward, next_state = map(np.array, zip(*steps, strict=True))
    model.add(Transitions(state, action, reward, next_state))
    np.testing.assert_array_equal(model.P[0, 1], [0.25, 0.75])
    np.testing.assert_array_equal(model.R[0, 1], [1.0, 4.0])
    np.testing.assert_array_equal(model.P[1, 0], [1.0, 0.0])
    assert np.isnan(model.P[0, 0]).all()
    with pytest.raises(ValueError, match="action 0 has no sample in state 0, nor have 1 other"):
        model.mdp(0.9)


@pytest.mark.parametrize("seed", range(5))
def test_all_methods_agree_on_random_worlds(seed):
    mdp = garnet(4, 2, np.random.default_rng(seed), gamma=0.8)
    plan, learned = value_iteration(mdp), learn(mdp, episode_steps=20)
    np.testing.assert_allclose(learned.Q, plan.Q, rtol=0, atol=0.25)
    distinct = np.abs(np.diff(plan.Q, axis=1)[:, 0]) > 0.1
    assert distinct.any()
    for policy in (policy_iteration(mdp).policy, learned.policy):
        assert (policy == plan.policy)[distinct].all()
        assert (solve(mdp, policy) > plan.V - 0.5).all()


def test_the_error_of_q_decreases_with_experience():
    mdp = garnet(4, 2, np.random.default_rng(0), gamma=0.8)
    history = learn(mdp, episode_steps=20, snapshots=(0, 100, 1_000, 20_000)).history
    errors = np.abs(history - value_iteration(mdp).Q).max(axis=(1, 2))
    assert history.shape == (4, 4, 2)
    assert not history[0].any()
    assert (np.diff(errors) < 0).all()


def test_q_of_a_corridor_follows_equation_52():
    learned = learn(corridor(2, gamma=0.5), steps=400, epsilon=1.0, power=1.0)
    # Right earns 2 each time; left has the mean of gamma * max Q at each visit.
    assert learned.Q[0, 1] == pytest.approx(2)
    assert 0.9 < learned.Q[0, 0] < 1
    shared = learn(toymaker(), observations=[0, 0], steps=500)
    assert shared.Q.shape == (1, 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"power": 0.5}, "power=0.5 must be more than 0.5"),
        ({"epsilon": 0}, "epsilon=0 must be more than 0"),
        ({"snapshots": (1, 600)}, "snapshots: 600 must be between 0 and steps=500"),
        ({"observations": [0]}, "observations must be 2 integers"),
        ({"observations": [0, -1]}, "observations must be 2 integers"),
    ],
)
def test_values_out_of_range_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        learn(toymaker(), steps=500, **options)
