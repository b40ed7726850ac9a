"""The room as an env of Gymnasium."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

HOURS = 0.25  # of a step


class Room(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One day in a room with a heater, which begins cold.

    The action is the power [1], 0 to 1. Observed [2] are how much too warm the room is (K) and the
    temperature outside (degrees Celsius). The reward of a step is 1 at the goal without heating.
    Above 40 degrees a fuse ends the episode.

    Args:
        goal: temperature, degrees Celsius.
    """

    def __init__(self, goal: float = 21.0) -> None:
        self.goal = goal
        self.observation_space = Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = Box(0, 1, (1,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a day; only the mean temperature outside is random."""
        super().reset(seed=seed)
        self.air, self.wall, self.mean, self.hour = 15.0, 14.0, self.np_random.uniform(-5, 10), 0.0
        return self._observed(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Heat for a quarter of an hour."""
        power = float(action[0])
        flows = 1.5 * (self.wall - self.air) + 0.3 * (self._outside() - self.air) + 15 * power
        walls = 0.4 * (self.air - self.wall) + 0.05 * (self._outside() - self.wall)
        self.air, self.wall, self.hour = (
            self.air + HOURS * flows,
            self.wall + HOURS * walls,
            self.hour + HOURS,
        )
        error = abs(self.air - self.goal)
        info = {"power": power, "in_band": error < 0.5}
        return self._observed(), max(0, 1 - error / 5) - 0.1 * power, self.air > 40, False, info

    def _outside(self) -> float:
        return self.mean + 5 * np.sin(2 * np.pi * self.hour / 24)

    def _observed(self) -> NDArray[np.float32]:
        return np.array([self.air - self.goal, self._outside()], np.float32)
