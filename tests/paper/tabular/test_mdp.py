import numpy as np
import pytest

from coil_paper.tabular import MDP, garnet, toymaker

P = np.array([[[0.5, 0.5], [1.0, 0.0]], [[0.0, 1.0], [0.3, 0.7]]])
R = np.array([[[1.0, 2.0], [3.0, 4.0]], [[0.0, 0.0], [5.0, 6.0]]])


def changed(array, index, value):
    copy = array.copy()
    copy[index] = value
    return copy


def test_expected_reward_and_q_weigh_by_probability():
    np.testing.assert_allclose(MDP(P, R, 0.9).r, [[1.5, 3.0], [0.0, 5.7]])
    np.testing.assert_allclose(toymaker().r, [[6, 4], [-3, -5]])
    found = MDP(P, R, 0.5).q(np.array([10.0, 20.0]))
    np.testing.assert_allclose(found, [[1.5 + 7.5, 3 + 5], [10, 5.7 + 8.5]])


def test_a_state_without_exit_and_reward_is_terminal():
    loop, reward = np.array([[[0.0, 1.0]], [[0.0, 1.0]]]), np.zeros((2, 1, 2))
    assert MDP(loop, reward, 0.9).terminal.tolist() == [False, True]
    assert not MDP(loop, changed(reward, (1, 0, 1), 1.0), 0.9).terminal.any()
    assert not MDP(P, R, 0.9).terminal.any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"P": changed(P, (1, 0), [0.1, 0.8])}, r"\(state low, action go\); they sum to 0.9"),
        ({"P": changed(P, (0, 1), [1.5, -0.5])}, r"P\[0, 1\]=.* \(state high, action stay\)"),
        ({"P": changed(P, (0, 1, 0), np.nan)}, "they sum to nan"),
        ({"P": P[0]}, r"P must have the shape \[S, A, S\]"),
        ({"R": R[0]}, r"R must have the shape of P, \(2, 2, 2\); it has \(2, 2\)"),
        ({"R": changed(R, (1, 1, 0), np.inf)}, r"finite \(state low, action stay\)"),
        ({"gamma": 1.0}, "gamma=1.0 must be less than 1"),
        ({"gamma": np.nan}, "gamma=nan"),
        ({"start": [0.5, 0.6]}, "start must be 2 probabilities"),
        ({"states": ("high",)}, "states has 1 names, but P has 2 states"),
    ],
)
def test_invalid_arrays_are_rejected(arguments, message):
    named = {"states": ("high", "low"), "actions": ("go", "stay")}
    with pytest.raises(ValueError, match=message):
        MDP(**({"P": P, "R": R, "gamma": 0.9} | named | arguments))


def test_a_policy_is_given_as_actions_or_probabilities():
    mdp = MDP(P, R, 0.9, states=("high", "low"))
    np.testing.assert_array_equal(mdp.probabilities([1, 0]), [[0, 1], [1, 0]])
    np.testing.assert_array_equal(mdp.probabilities([[0.5, 0.5], [1, 0]]), [[0.5, 0.5], [1, 0]])
    for policy, message in {
        (1, 2): r"policy\[1\]=2 is no action in state low; actions are 0 to 1",
        (0.5, 0.5): "A policy is",
        (0, 0, 0): "A policy is",
        ((0.5, 0.5), (0.5, 0.6)): r"policy\[1\]=.* state low",
    }.items():
        with pytest.raises(ValueError, match=message):
            mdp.probabilities(policy)


def test_a_garnet_has_three_branches_and_is_reproducible():
    mdp, again, other = (garnet(7, 3, np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert ((mdp.P > 0).sum(axis=2) == 3).all()
    np.testing.assert_array_equal(mdp.R, again.R)
    assert (mdp.R != other.R).any()
