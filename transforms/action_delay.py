"""Actions that take effect late, as by a network, a motor controller or a slow policy."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Bounded, TensorSpec, Unbounded

from coil_rl.transforms.action_space import nested_key
from coil_rl.transforms.disturbance import Delay, Lag
from coil_rl.transforms.link import State


class ActionDelay(Delay):
    """Actions take effect some steps later; until then the first action of the episode does.

    Each row draws its delay for each episode, uniformly from `min_lag` to `max_lag` steps. The
    action may be numbers or choices. The agent's own action stays in the data; guides that read
    `last_action` are told the one in force. With `LastAction` an agent can know what is on its way.

    Args:
        action_key: entry of the action.
        memory_key: entry for the lag of each row, and for the actions on their way, oldest first.

    Raises:
        ValueError: for `min_lag` above `max_lag`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> cars = ConeTrackEnv(shipped_tracks("train"), num_envs=8)
        >>> env = TransformedEnv(cars, ActionDelay(min_lag=2, max_lag=2))
        >>> step = env.rollout(4)
        >>> torch.equal(step["next", "steering"][:, 3], step["action"][:, 1])
        True
    """

    def __init__(
        self,
        min_lag: Lag = 0,
        max_lag: Lag = 2,
        action_key: NestedKey = "action",
        seed: int = 0,
        memory_key: NestedKey = "late_actions",
    ) -> None:
        super().__init__(min_lag, max_lag, seed, memory_key)
        self.action_key: NestedKey = nested_key(action_key)

    def _kept(self) -> dict[NestedKey, TensorSpec]:
        # Not the spec of the action, as zeros, which stand for no action yet, need not be one.
        spec = self.parent.full_action_spec[self.action_key]
        kept = Unbounded(spec.shape, device=spec.device, dtype=spec.dtype)
        return {self._of_memory("past"): kept}

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """Lag and age of each row, and the actions on their way."""
        age = self._of_rows(Bounded, 0, self.max_lag, dtype=torch.int64)
        return {**super().state, self._of_memory("age"): age}

    @cached_property
    def _empty(self) -> State:
        """The memory at the start of an episode."""
        return {key: spec.zero() for key, spec in self.state.items()}

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Draw the lags."""
        return {**self._empty, self._of_memory("lag"): self._drawn(data)}

    def act(self, data: TensorDictBase, state: State) -> State:
        """Write the action that takes effect now, and keep the one that was chosen."""
        past, age = self._of_memory("past"), self._of_memory("age")
        lag = torch.minimum(state[self._of_memory("lag")], state[age])
        return {
            **state,
            age: (state[age] + 1).clamp(max=self.max_lag),
            past: self._delay(data, self.action_key, state[past], lag),
        }
