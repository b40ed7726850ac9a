"""An env of Gymnasium for any spaces, which keeps what it shows and what it is given."""

import gymnasium
import numpy as np
from gymnasium import spaces

UNIT = spaces.Box(-1, 1, (1,))


class Plant(gymnasium.Env):
    """Shows samples of its space; the reward is the sum of the action.

    Args:
        observations: its observation space.
        actions: its action space.
        end: number of steps after which an episode is truncated; None: never.
    """

    def __init__(self, observations=UNIT, actions=UNIT, end=None):
        self.observation_space, self.action_space, self.end = observations, actions, end
        self.shown, self.given = [], []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.time = 0
        return self.look(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.given.append(np.array(action))
        self.time += 1
        return self.look(), float(np.sum(action)), False, self.time == self.end, {}

    def look(self):
        self.shown.append(self.observation_space.sample())
        return self.shown[-1]


class Drift(Plant):
    """Its state moves with its action, and a little at random."""

    def __init__(self):
        super().__init__(spaces.Box(-np.inf, np.inf, (2,)), end=20)

    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        self.time = 0
        self.begin(seed)
        return self.look(), {}

    def step(self, action):
        self.time += 1
        self.move(float(np.ravel(action)[0]))
        return self.look(), float(self.state[0]), False, self.time == self.end, {}

    def begin(self, seed):
        self.state = [self.np_random.uniform(), 0.0]

    def move(self, action):
        self.state[0] += action + 0.1 * self.draw()
        self.state[1] += 1.0

    def draw(self):
        return 0.0

    def look(self):
        return np.array(self.state, np.float32)
