"""Envs and controllers of other people, each with something unusual."""

import gymnasium
import numpy as np
from gymnasium import spaces


class Plain(gymnasium.Env):
    """Two numbers; the best action is the first of them. An episode has ten steps."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.look(), {}

    def step(self, action):
        reward = -abs(float(self.seen[0]) - float(np.sum(np.asarray(action, np.float64))))
        self.steps += 1
        return self.look(), reward, False, self.steps >= 10, {}

    def look(self):
        self.seen = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.seen


SPACES = {
    "wide": spaces.Box(200, 1000, (1,)),
    "unit": spaces.Box(0, 1, (1,)),
    "half": spaces.Box(np.float32([0.0]), np.float32([np.inf])),
    "scalar": spaces.Box(0, 10, ()),
    "from5": spaces.Discrete(3, start=5),
    "half_floats": spaces.Box(-1, 1, (1,), np.float16),
    "switches": spaces.MultiBinary(3),
}


class Acts(Plain):
    """Its action space is one of `SPACES`.

    Args:
        space: the name.
    """

    def __init__(self, space="wide"):
        self.action_space = SPACES[space]


def first(observation):
    return observation[:1]


def seven(observation):
    return 7


def six(observation):
    return 6


def far(observation):
    return np.array([5e6])


def on(observation):
    return np.array([1, 0, 1])
