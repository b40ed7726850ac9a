import numpy as np
import pytest
from scipy.stats import chisquare

from coil_rl.tabular import MDP, Gridworld, Simulator, experience, garnet

ANYTHING = np.full((5, 2), 0.5)


def test_transitions_come_as_often_as_their_probabilities_say():
    mdp = garnet(5, 2, np.random.default_rng(1))
    seen = experience(mdp, ANYTHING, 20_000, np.random.default_rng(0))
    for s in range(5):
        for a in range(2):
            chosen = seen.following[(seen.state == s) & (seen.action == a)]
            counts, possible = np.bincount(chosen, minlength=5), mdp.P[s, a] > 0
            assert counts[~possible].sum() == 0
            expected = mdp.P[s, a, possible] / mdp.P[s, a, possible].sum() * len(chosen)
            assert chisquare(counts[possible], expected).pvalue > 1e-4
    np.testing.assert_array_equal(seen.reward, mdp.R[seen.state, seen.action, seen.following])
    np.testing.assert_array_equal(seen.following[:-1], seen.state[1:])


def test_the_same_seed_lives_through_the_same():
    mdp = garnet(5, 2, np.random.default_rng(1))
    first, again, other = (experience(mdp, ANYTHING, 100, np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.state, again.state)
    assert (first.state != other.state).any()


def test_an_episode_begins_anew_at_the_start_after_a_terminal_state_or_its_time():
    world = Gridworld(("S.G",), slip=0).mdp
    right = np.full(3, 1)
    assert experience(world, right, 6, np.random.default_rng(0)).state.tolist() == [0, 1] * 3
    assert experience(world, right, 3, np.random.default_rng(0), episode=1).state.tolist() == [0] * 3


def test_impossible_states_are_never_reached_though_probabilities_are_rounded():
    P = np.zeros((11, 1, 11))
    P[:, 0, :10] = 0.1  # adds up to 0.9999999999999999

    class Last:
        def random(self):
            return np.nextafter(1, 0)

    world = Simulator(MDP(P, np.ones_like(P), 0.9, start=P[0, 0]), Last())
    assert world.state == 9
    assert world.step(0) == (1.0, 9)


def test_no_steps_are_no_experience():
    assert len(experience(garnet(5, 2, np.random.default_rng(1)), ANYTHING, 0, np.random.default_rng(0)).state) == 0


def test_an_episode_without_a_step_is_refused():
    with pytest.raises(ValueError, match="episode=0 must be at least one step"):
        Simulator(Gridworld().mdp, np.random.default_rng(0), episode=0)
