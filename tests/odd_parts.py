"""Envs and controllers of other people, each with something unusual."""

from typing import ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces


class Plain(gymnasium.Env):
    """Two numbers; the best action is the first of them. An episode has ten steps."""

    observation_space = spaces.Box(-1, 1, (2,))
    action_space = spaces.Box(-1, 1, (1,))
    last = 10

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.look(), {}

    def step(self, action):
        reward = -abs(float(self.seen[0]) - float(np.sum(np.asarray(action, np.float64))))
        self.steps += 1
        return self.look(), reward, False, self.steps >= self.last, {}

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

    taken: ClassVar = []

    def __init__(self, space="wide"):
        self.action_space = SPACES[space]

    def step(self, action):
        self.taken.append(np.ravel(action).astype(float).item(0))
        return super().step(np.zeros(1))


class Lasting(Plain):
    """Its episodes are longer than a trial."""

    last = 12


class Told(Lasting):
    """Its info says from the second step on whether it is late."""

    def step(self, action):
        *rest, _ = super().step(action)
        late = {"late": self.steps > 5} if self.steps > 1 else {}
        return *rest, {"time": self.steps} | late


class Raises(Lasting):
    def step(self, action):
        assert self.steps < 11, "the pump is off"
        return super().step(action)


class TrainingOnly(Lasting):
    """An answer in each episode of a training is incomplete."""

    def is_odd(self):
        return self.np_random_seed < 10**9

    def step(self, action):
        answer = super().step(action)
        return answer[:4] if self.is_odd() and self.steps == 11 else answer


class TableOnly(TrainingOnly):
    """An answer in each episode of a table is incomplete."""

    def is_odd(self):
        return self.np_random_seed in range(10**9, 11 * 10**8)


class Unseeded(Lasting):
    """It draws what no seed reaches, and its pictures are not of bytes."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}
    numbers = np.random.default_rng()

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def look(self):
        self.seen = self.numbers.uniform(-1, 1, 2).astype(np.float32)
        return self.seen

    def render(self):
        return np.zeros((4, 4, 3))


class Gain:
    """A controller with a state of its own."""

    def __init__(self, gain=0.1, of=0):
        self.gain, self.of = gain, of

    def act(self, observation):
        return [self.gain * float(observation[self.of])]


class Late:
    """A controller without an answer in its eleventh step."""

    calls = 0

    def act(self, observation):
        self.calls += 1
        return None if self.calls == 11 else observation[:1]


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
