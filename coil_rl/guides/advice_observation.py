"""The advice of a controller in the observation of any Gymnasium env, for other libraries."""

from __future__ import annotations

import copy
from typing import Any, SupportsFloat, TypeGuard

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from coil_rl.foreign.beside import maker_beside
from coil_rl.foreign.codec import Actions
from coil_rl.foreign.host import Host
from coil_rl.transforms.action_space import ActionSpace

ADVICE = "guide_action"  # key of the advice in an observation of several entries


class AdviceObservation(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Any Gymnasium env with the advice of a controller in its observation: COIL elsewhere.

    The advice is a vector as in this package. Real numbers are normalised: -1 and 1 are the bounds
    of the action; a number without bounds stays in the unit of the env. Choices are one-hot vectors
    side by side.

    The advice is appended to an observation that is a vector of real numbers. A Dict observation
    gets the entry `guide_action`; any other one becomes a Dict of `observation` and `guide_action`.
    The observation after a termination repeats the advice before it.

    Args:
        env: the env. Its actions are a Box, Discrete, MultiDiscrete or MultiBinary.
        controller: whose action is the advice: anything that a guide may be, as for `train`, or a
            class or function with a parameter `env`, called as `THING(env)` and
            `THING(env, observation)`.

    Attributes:
        advice: in the last observation, [A]; None before the first reset.

    Raises:
        ValueError: for an action space that is not supported, a controller that cannot be made, or
            a Dict observation with an entry `guide_action`.
        ForeignError: at a reset or a step, for what the controller raises, or gives that is no
            action of the env.

    Example:
        >>> env = AdviceObservation(gymnasium.make("CartPole-v1"), lambda seen: int(seen[2] > 0))
        >>> observation, _ = env.reset(seed=0)
        >>> observation.shape, observation[4:].tolist()
        ((6,), [1.0, 0.0])
    """

    def __init__(self, env: gymnasium.Env[Any, Any], controller: Any) -> None:
        super().__init__(env)
        self.actions = Actions(type(env.unwrapped).__name__, env.action_space, torch.float32)
        self.space = ActionSpace(self.actions.spec, 0, self.actions.first)
        self.host = Host(maker_beside(controller, "advice", env), "advice")
        self.advice: NDArray[np.float32] | None = None
        self.observation_space = self._with(env.observation_space, self._advice_space())

    def _advice_space(self) -> spaces.Box:
        """Return the space of the advice."""
        units, size = self.space.units, int(self.space.agents.numel()) * self.space.size
        if units is None:  # choices
            return spaces.Box(0.0, 1.0, (size,), np.float32)
        return spaces.Box(
            units.low.flatten().numpy(), units.high.flatten().numpy(), (size,), np.float32
        )

    def _with(self, space: spaces.Space[Any], advice: spaces.Box) -> spaces.Space[Any]:
        """Return the space of observations with advice."""
        if isinstance(space, spaces.Dict):
            if ADVICE in space.spaces:
                raise ValueError(
                    f"the observation has an entry {ADVICE!r} already: rename it with a wrapper"
                )
            return spaces.Dict({**space.spaces, ADVICE: advice})
        if not _is_vector(space):
            return spaces.Dict({"observation": space, ADVICE: advice})
        low = np.concatenate([space.low.astype(np.float32), advice.low])
        high = np.concatenate([space.high.astype(np.float32), advice.high])
        return spaces.Box(low, high, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of env and controller.

        Args:
            seed: of the env.
            options: of the env.
        """
        observation, info = self.env.reset(seed=seed, options=options)
        with self.host.numbers:
            self.host.begin()
        self._advise(observation)
        return self._observed(observation), info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Do a step, and ask the controller for its next action.

        Args:
            action: of the env; the advice is not obeyed.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if not terminated:
            self._advise(observation)
        return self._observed(observation), reward, terminated, truncated, info

    def _advise(self, observation: Any) -> None:
        with self.host.numbers:
            given = self.host.act(copy.deepcopy(observation))
        action = torch.as_tensor(self.actions.fitted(given, self.host.place))
        shape = self.space.event or action.shape
        vectors = self.space.advice(action.reshape(shape), torch.Size())
        self.advice = self.space.normalise(vectors).flatten().numpy().astype(np.float32)

    def _observed(self, observation: Any) -> Any:
        """Return an observation with the present advice."""
        space = self.env.observation_space
        advice = np.copy(self.advice)  # type: ignore[arg-type]
        if isinstance(space, spaces.Dict):
            return {**observation, ADVICE: advice}
        if not _is_vector(space):
            return {"observation": observation, ADVICE: advice}
        return np.concatenate([np.asarray(observation, np.float32), advice])


def _is_vector(space: spaces.Space[Any]) -> TypeGuard[spaces.Box]:
    """Return whether observations are vectors of real numbers."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        return False
    return bool(np.issubdtype(space.dtype, np.floating))
