"""Running scale of rewards."""

import gymnasium
import numpy as np
import pytest
import torch
from any_env import AnyEnv, action_of, learning
from tensordict import TensorDict

from coil_rl.learners import DQN, PPO, SAC, TRPO
from coil_rl.learners.normaliser import Moments
from coil_rl.learners.rewards import RewardScale


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


@pytest.mark.parametrize("kind", [PPO, SAC])
def test_new_episodes_do_not_begin_with_the_returns_of_those_before(kind):
    learner, rollout = learning(kind, AnyEnv(action=action_of(kind)), scale_rewards=True)
    scale = getattr(learner, "reward_scale", None) or learner.extensions.each[0]
    learner.update(rollout.collect())
    assert scale.running.any()
    learner.begin_episodes()
    scale.moments = Moments(torch.Size([]))
    scale.learn(batch_of([[3.0]], [[False]]))
    assert scale.moments.mean == 3


def test_rewards_that_are_0_stay_and_equal_returns_are_divided_by_their_size():
    scale = RewardScale(0.9)
    scale.learn(batch_of([[0.0, 0.0]], [[False, False]]))
    assert scale.scale == 1
    scale = RewardScale(0.9)
    scale.learn(batch_of([[-7.0, -7.0]], [[True, True]]))
    assert scale.scale == 7


@pytest.mark.parametrize("kind", [PPO, TRPO, SAC, DQN])
def test_batch_keeps_the_rewards_of_the_env(kind):
    learner, rollout = learning(kind, AnyEnv(action=action_of(kind)), scale_rewards=True)
    batch = rollout.collect()
    batch["next", "reward"] *= 1000
    given = batch["next", "reward"].clone()
    assert learner.update(batch)["reward_scale"] > 10
    assert torch.equal(batch["next", "reward"], given)
