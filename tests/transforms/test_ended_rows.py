"""Controllers with one object for each row are not asked after the end of an episode."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs import Compose, TransformedEnv

from coil_rl import GymnasiumEnv, evaluate_policy
from coil_rl.guides import ControllerGuide, FollowAdvice
from coil_rl.run.rollout import Rollout
from coil_rl.transforms import GuideActions

ROWS, STEPS = 4, 20


class Counts(gymnasium.Env):
    """Ends after 3 steps, and with an odd seed after 5; observes how many are left."""

    observation_space = spaces.Box(0, 5, (1,), np.float32)

    def __init__(self, choices, ends):
        self.action_space = spaces.Discrete(6) if choices else spaces.Box(1, 9, (1,), np.float32)
        self.ends = ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 5 if seed % 2 else 3
        return np.array([self.left], np.float32), {}

    def step(self, action):
        self.left -= 1
        over = self.left == 0
        ends = (over, False) if self.ends == "terminated" else (False, over)
        return np.array([self.left], np.float32), 1.0, *ends, {}


class Plan:
    """Has an action for each step that the env takes, and no more."""

    def reset(self):
        self.plan = None

    def act(self, observation):
        if self.plan is None:
            self.plan = list(range(1, int(observation[0]) + 1))
        return self.plan.pop()


class LongerPlan(Plan):
    """Has one for the observation after the last step, too."""

    def act(self, observation):
        return super().act(observation) if observation[0] else 1


def planned(plan, choices, ends, **others):
    guides = {"plan": ControllerGuide(plan), **others}
    env = GymnasiumEnv(Counts, ROWS, options={"choices": choices, "ends": ends})
    return TransformedEnv(env, Compose(GuideActions(guides)))


@pytest.mark.parametrize("choices", [False, True])
def test_ended_rows_keep_their_advice_and_are_not_asked(choices):
    two = ControllerGuide(lambda observation: 2)
    env = planned(Plan, choices, "terminated", two=two)
    batch = Rollout(env, FollowAdvice(env), STEPS).collect()
    over = batch["next", "terminated"].squeeze(-1)
    assert len(set(over.sum(1).tolist())) > 1, "episodes of two lengths should end"
    assert torch.equal(batch["next", "guide_action"][over], batch["guide_action"][over])
    first, second = batch["guide_action"].unbind(-2)
    if choices:
        first, second = (each.argmax(-1, keepdim=True) for each in (first, second))
    assert torch.equal(first, batch["observation"])
    assert (second == 2).all()
    of_plan, of_function = ROWS * (1 + STEPS), ROWS * (1 + STEPS) + over.sum()
    assert env.transform[0].calls == of_plan + of_function


def test_row_that_is_truncated_in_training_is_asked_for_its_last_observation():
    env = planned(LongerPlan, False, "truncated")
    batch = Rollout(env, FollowAdvice(env), STEPS).collect()
    over = batch["next", "truncated"].squeeze(-1)
    assert (batch["next", "guide_action"][over] == 1).all()
    assert env.transform[0].calls == ROWS * (1 + STEPS) + over.sum()


@pytest.mark.parametrize("ends", ["terminated", "truncated"])
@pytest.mark.parametrize("choices", [False, True])
def test_in_an_evaluation_a_controller_is_asked_once_a_step(choices, ends):
    env = planned(Plan, choices, ends)
    episodes = evaluate_policy(env, FollowAdvice(env)).episodes
    steps = [episode["steps"] for episode in episodes]
    assert set(steps) == {3, 5}
    assert env.transform[0].calls == sum(steps)
