import numpy as np
import pytest

from coil_rl.tabular import Gridworld, garnet, policy_iteration, q_learning, solve, toymaker, value_iteration


def learn(mdp, seed=0, steps=20_000, **options):
    return q_learning(mdp, steps, np.random.default_rng(seed), **({"epsilon": 0.3} | options))


@pytest.mark.parametrize("seed", range(3))
def test_all_three_methods_agree_on_the_toymaker(seed):
    mdp = toymaker()
    policies = [value_iteration(mdp).policy, policy_iteration(mdp).policy, learn(mdp, seed).policy]
    assert [policy.tolist() for policy in policies] == [[1, 1]] * 3


@pytest.mark.parametrize("seed", range(10))
def test_all_three_methods_agree_on_random_worlds(seed):
    mdp = garnet(4, 2, np.random.default_rng(seed), gamma=0.8)
    plan, learned = value_iteration(mdp), learn(mdp, episode=20)
    np.testing.assert_allclose(learned.Q, plan.Q, rtol=0, atol=0.25)
    clear = np.abs(np.diff(plan.Q, axis=1)[:, 0]) > 0.1
    assert clear.any()
    for policy in (policy_iteration(mdp).policy, learned.policy):
        assert (policy == plan.policy)[clear].all()
        assert (solve(mdp, policy) > plan.V - 0.5).all()


def test_q_comes_nearer_with_more_experience():
    mdp = garnet(4, 2, np.random.default_rng(0), gamma=0.8)
    best, steps = value_iteration(mdp).Q, (0, 100, 1_000, 20_000)
    history = learn(mdp, episode=20, snapshots=steps).history
    errors = np.abs(history - best).max(axis=(1, 2))
    assert history.shape == (4, 4, 2)
    assert not history[0].any()
    assert (np.diff(errors) < 0).all()


def test_it_finds_the_way_through_the_gridworld():
    world = Gridworld()
    learned = learn(world.mdp, steps=40_000, episode=50)
    start = np.argmax(world.mdp.start)
    assert solve(world.mdp, learned.policy)[start] == pytest.approx(value_iteration(world.mdp).V[start], abs=0.02)
    assert not learned.visits[world.mdp.terminal].any()


def test_the_first_steps_are_those_of_equation_52():
    world = Gridworld(("SG",), slip=0, goal=2.0, step=0.0, gamma=0.5).mdp
    learned = q_learning(world, 400, np.random.default_rng(0), epsilon=1.0, power=1.0)
    # To the goal for 2 each time; from where nothing happens, the mean of what was seen, half of what 2 was then.
    assert learned.Q[0, 1] == pytest.approx(2)
    assert 0.9 < learned.Q[0, 0] < 1
    assert learned.visits.sum() == 400


def test_the_same_seed_learns_the_same():
    mdp = toymaker()
    assert (learn(mdp, 1, 500).Q == learn(mdp, 1, 500).Q).all()
    assert (learn(mdp, 1, 500).Q != learn(mdp, 2, 500).Q).any()


def test_states_that_look_alike_share_what_is_learned():
    learned = learn(toymaker(), sees=[0, 0], steps=500)
    assert learned.Q.shape == (1, 2)
    assert learned.visits.sum() == 500


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"power": 0.5}, "power=0.5 must be more than 1/2 and at most 1"),
        ({"power": 1.1}, "power=1.1"),
        ({"epsilon": 0}, "epsilon=0 must be more than 0"),
        ({"epsilon": 1.1}, "epsilon=1.1"),
        ({"snapshots": (1, 600)}, "snapshots: 600 must be between 0 and steps=500"),
        ({"sees": [0]}, "sees must be 2 whole numbers"),
        ({"sees": [0, -1]}, "sees must be 2 whole numbers"),
    ],
)
def test_values_outside_their_range_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        learn(toymaker(), steps=500, **options)
