"""A method that needs numbers as actions is refused where they are choices."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from hydra import compose, initialize_config_module
from programs import shipped

from coil_rl.config.check import check
from coil_rl.errors import UserError

METHODS = shipped("method")
# Methods that take choices as actions; all others need numbers.
WITH_CHOICES = (
    *("coil_anchored", "coil", "coil_dropout", "rfc", "coil_rfc", "kickstart", "jump_start"),
    *("imitate_then_ppo", "advisor", "dagger", "oil", "ppo"),
)
# They have no agent, or need several guides, or numbers of a guide.
OTHERS = ("guide", "coil_multi", "tune")


class Switches(gymnasium.Env):
    """Three switches are set at once, for five steps."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.MultiBinary(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.np_random.uniform(-1, 1, 2).astype(np.float32), {}

    def step(self, action):
        self.steps += 1
        observation = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return observation, float(np.sum(action)), False, self.steps >= 5, {}


def on(observation):
    return np.array([1, 0, 1])


def checked(method, tmp_path, *words):
    env = ["env=gym", f"env.id={__name__}:Switches", "evaluation.cases=2"]
    guide = ["guide=controller", f"guide.controller.of={__name__}:on"]
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        config = compose("train", [*env, *guide, f"method={method}", f"run_dir={tmp_path}", *words])
    check(config)


@pytest.mark.fast(2)
@pytest.mark.parametrize("method", sorted({*METHODS} - {*OTHERS}))
def test_method_takes_choices_or_is_refused_with_those_that_do(method, tmp_path):
    if method in WITH_CHOICES:
        checked(method, tmp_path)
        return
    message = r" needs continuous actions, but this env .* method=coil_anchored"
    with pytest.raises(UserError, match=message):
        checked(method, tmp_path)
