import numpy as np
import pytest

from coil_rl.tabular import Experience, ModelEstimate, experience, garnet, solve, value_iteration


def test_counting_is_the_share_of_transitions_and_their_mean_reward():
    model = ModelEstimate(2, 2)
    model.add(
        Experience(
            state=np.array([0, 0, 0, 0, 1]),
            action=np.array([1, 1, 1, 1, 0]),
            reward=np.array([1.0, 2.0, 3.0, 7.0, 5.0]),
            following=np.array([0, 1, 1, 1, 0]),
        )
    )
    np.testing.assert_array_equal(model.P[0, 1], [0.25, 0.75])
    np.testing.assert_array_equal(model.R[0, 1], [1.0, 4.0])
    np.testing.assert_array_equal(model.P[1, 0], [1.0, 0.0])
    assert np.isnan(model.P[0, 0]).all()
    with pytest.raises(ValueError, match="action 0 was never tried in state 0, nor 1 other pairs"):
        model.mdp(0.9)


@pytest.mark.parametrize("seed", range(5))
def test_more_experience_makes_a_better_plan(seed):
    mdp, rng = garnet(5, 2, np.random.default_rng(seed)), np.random.default_rng(seed)
    model, best, errors = ModelEstimate(5, 2), value_iteration(mdp), []
    for steps in (200, 20_000):
        model.add(experience(mdp, np.full((5, 2), 0.5), steps, rng, episode=10))
        plan = value_iteration(model.mdp(mdp.gamma))
        errors.append(np.abs(plan.Q - best.Q).max())
    # Some 2000 tries a pair leave a mean that is off by 1/45 of its spread, ten times that in all at gamma = 0.9.
    assert errors[1] < min(errors[0], 0.3)
    assert (solve(mdp, plan.policy) > best.V - 0.1).all()
