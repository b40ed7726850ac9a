"""Running scale of rewards: what a learner learns does not depend on their unit."""

import copy

import gymnasium
import numpy as np
import pytest
import torch
from any_env import AnyEnv, check_same_update
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical

from coil_rl.learners import A2C, DQN, PPO, SAC, TRPO, Reinforce
from coil_rl.learners.reward_scale import RewardScale
from coil_rl.run.rollout import Rollout

KINDS = [PPO, A2C, Reinforce, TRPO, SAC, DQN]


class InUnit(AnyEnv):
    """An env whose rewards have a unit: another one gives the same rewards times a number."""

    def __init__(self, action, unit):
        super().__init__(8, action, {"observation": Bounded(-1, 1, (3,))})
        self.unit = unit

    def _step(self, tensordict):
        after = super()._step(tensordict)
        return after.set("reward", after["reward"] * self.unit)


def learner_in(kind, unit, **options):
    """Return a learner and the rollout in its env."""
    torch.manual_seed(0)
    env = InUnit(Categorical(3, ()) if kind is DQN else None, unit)
    replay = {"starts": 16, "batch_size": 16, "updates_per_step": 0.125}
    options |= {"minibatches": 2} if kind not in (SAC, DQN) else replay
    learner = kind(env, **options)
    return learner, Rollout(env, learner.policy, 8, learner.keys)


def learned(kind, unit, **options):
    """Return the weights of the policy after three updates."""
    learner, rollout = learner_in(kind, unit, **options)
    for _ in range(3):
        learner.update(rollout.collect())
    return torch.cat([each.detach().flatten() for each in learner.policy.parameters()])


@pytest.mark.fast(2)
@pytest.mark.parametrize("kind", KINDS)
def test_weights_are_the_same_in_any_unit_of_the_reward(kind):
    one, other = (learned(kind, unit, scale_rewards=True) for unit in (1.0, 2.0**20))
    assert torch.equal(one, other)
    torch.testing.assert_close(learned(kind, 1e-6, scale_rewards=True), one, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("kind", [PPO, SAC])
def test_without_the_scale_the_unit_changes_the_weights(kind):
    assert not torch.allclose(learned(kind, 1.0), learned(kind, 2.0**20), rtol=1e-2, atol=1e-3)


def batch_of(rewards, ended):
    after = {"reward": torch.tensor(rewards)[..., None], "done": torch.tensor(ended)[..., None]}
    return TensorDict({"next": after}, [*torch.tensor(rewards).shape])


class Given(gymnasium.Env):
    """An env without an end that gives some rewards."""

    observation_space = action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, rewards):
        self.rewards = iter(rewards)

    def reset(self, *, seed=None, options=None):
        return 0, {}

    def step(self, action):
        return 0, next(self.rewards), False, False, {}


def test_scale_is_that_of_gymnasium():
    rewards = [float(each) for each in np.random.default_rng(0).normal(5, 100, 1000)]
    theirs = gymnasium.wrappers.NormalizeReward(Given(rewards), gamma=0.9)
    theirs.reset()
    for _ in rewards:
        theirs.step(0)
    scale = RewardScale(0.9)
    for begin in range(0, 1000, 50):
        scale.learn(batch_of([rewards[begin : begin + 50]], [[False] * 50]))
    assert scale.scale == pytest.approx(float(theirs.return_rms.var) ** 0.5, rel=1e-4)


def test_returns_go_on_from_batch_to_batch_and_end_with_their_episodes():
    scale = RewardScale(0.5)
    scale.prepare(batch_of([[1.0, 2.0], [4.0, 0.0]], [[False, False], [True, False]]))
    scale.prepare(batch_of([[3.0], [1.0]], [[True], [False]]))
    returns = torch.tensor([1.0, 2.5, 4.0, 0.0, 4.25, 1.0]).double()
    assert scale.scale == pytest.approx(float(returns.std(correction=0)))


def test_rewards_that_are_0_stay_and_equal_returns_are_divided_by_their_size():
    scale = RewardScale(0.9)
    scale.learn(batch_of([[0.0, 0.0]], [[False, False]]))
    assert scale.scale == 1
    scale = RewardScale(0.9)
    scale.learn(batch_of([[-7.0, -7.0]], [[True, True]]))
    assert scale.scale == 7


@pytest.mark.fast(3)
@pytest.mark.parametrize("kind", KINDS)
def test_batch_keeps_the_rewards_of_the_env_and_a_resumed_learner_goes_on(kind):
    learner, rollout = learner_in(kind, 1000.0, scale_rewards=True)
    for _ in range(3):
        batch = rollout.collect()
        given = batch["next", "reward"].clone()
        assert learner.update(batch)["reward_scale"] > 10
        assert torch.equal(batch["next", "reward"], given)
    other, _ = learner_in(kind, 1000.0, scale_rewards=True)
    other.load_state_dict(copy.deepcopy(learner.state_dict()))
    check_same_update(learner, other, rollout.collect())
