"""What all learners have: digits that depend on no unit, and a state that is complete."""

import copy

import pytest
import torch
from any_env import AnyEnv, action_of, check_same_update, learning
from torchrl.data import Bounded

from coil_rl.foreign.remembered import copied
from coil_rl.learners import A2C, DQN, PPO, SAC, TQC, TRPO, CrossQ, Reinforce

KINDS = [PPO, A2C, Reinforce, TRPO, SAC, DQN]


class InUnits(AnyEnv):
    """An env whose observations and rewards have units and a centre."""

    def __init__(self, kind, unit=1.0, centre=0.0, reward_unit=1.0):
        low, high = (unit * torch.tensor([-1.0, end]) + centre for end in (-1.0, 1.0))
        super().__init__(8, action_of(kind), {"observation": Bounded(low, high, (2,))})
        self.reward_unit = reward_unit

    def _step(self, tensordict):
        after = super()._step(tensordict)
        return after.set("reward", after["reward"] * self.reward_unit)


def learned(kind, units, **options):
    """Return the weights of the policy after three updates."""
    torch.manual_seed(0)
    learner, rollout = learning(kind, InUnits(kind, **units), **options)
    for _ in range(3):
        learner.update(rollout.collect())
    return torch.nn.utils.parameters_to_vector(learner.policy.parameters())


@pytest.mark.fast(2)
@pytest.mark.parametrize("kind", KINDS)
def test_learner_learns_the_same_in_every_unit_and_around_every_centre(kind):
    expected = learned(kind, {}, normalise=True)
    for units in ({"unit": 1e-4}, {"unit": 1e3, "centre": -2e5}):
        found = learned(kind, units, normalise=True)
        torch.testing.assert_close(found, expected, rtol=1e-2, atol=1e-3)


@pytest.mark.fast(2)
@pytest.mark.parametrize("kind", KINDS)
def test_learner_learns_the_same_in_every_unit_of_the_reward(kind):
    expected, large, small = (
        learned(kind, {"reward_unit": unit}, scale_rewards=True) for unit in (1.0, 2.0**20, 1e-6)
    )
    assert torch.equal(large, expected)
    torch.testing.assert_close(small, expected, rtol=1e-2, atol=1e-3)


@pytest.mark.fast(4)
@pytest.mark.parametrize("updates", [1, 3])  # a buffer that is not full, and one that is
@pytest.mark.parametrize(
    ("kind", "options"),
    [
        *((kind, {"normalise": True, "scale_rewards": True}) for kind in KINDS),
        *((kind, {"normalise": "auto"}) for kind in (PPO, SAC, CrossQ)),
        (TQC, {"normalise": True, "n_step": 3}),
    ],
)
def test_restored_learner_goes_on_with_the_same_digits(kind, options, updates):
    torch.manual_seed(0)
    replay = {} if issubclass(kind, PPO) else {"capacity": 150}
    first, rollout = learning(kind, InUnits(kind, unit=1e3), **options, **replay)
    for _ in range(updates):
        first.update(rollout.collect())
    second, _ = learning(kind, InUnits(kind, unit=1e3), **options, **replay, seed=9)
    second.load_state_dict(copied(first.state_dict()))  # as a checkpoint gives it back
    check_same_update(first, second, rollout.collect())
    if replay:
        assert (first.buffer[:] == second.buffer[:]).all()


@pytest.mark.parametrize("kind", [TRPO, SAC, DQN])
def test_copied_learner_learns_as_the_first_does(kind):
    torch.manual_seed(0)
    first, rollout = learning(kind, InUnits(kind))
    first.update(rollout.collect())
    second = copy.deepcopy(first)
    before = copy.deepcopy(second.policy.state_dict())
    check_same_update(first, second, rollout.collect())
    after = second.policy.state_dict()
    assert any(not torch.equal(value, after[name]) for name, value in before.items())
