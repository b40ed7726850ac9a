"""The agent's own last actions as an observation, for envs in which actions take effect late."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import TensorSpec, Unbounded

from coil_rl.ranges import Interval, checked
from coil_rl.transforms.action_space import ActionTransform, nested_key
from coil_rl.transforms.link import State


@checked
class LastAction(ActionTransform):
    """Writes the actions that the agent chose in the steps before, newest first.

    TorchRL's transform of this name writes the action that the env was given, which may be another
    one. This one belongs to the method, behind `GuideActions`: an agent observes it wherever it
    drives, whether actions are late there or not.

    Args:
        steps: number of actions, at least 1: as many as may be on their way.
        action_key: entry of the action.
        out_key: entry for the actions as numbers, [*batch, steps * A], one-hot for choices; with an
            action for each of several agents [*batch, n_agents, steps * A]. 0 for no action yet.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> cars = ConeTrackEnv(shipped_tracks("train"), num_envs=8)
        >>> env = TransformedEnv(cars, LastAction(steps=2))
        >>> env.reset()["last_action"].shape
        torch.Size([8, 2])
    """

    needs_past = True

    def __init__(
        self,
        steps: Annotated[int, Interval(ge=1, le=1000)] = 1,
        action_key: NestedKey = "action",
        out_key: NestedKey = "last_action",
    ) -> None:
        out_key = nested_key(out_key)
        super().__init__(in_keys=[], out_keys=[out_key])
        self.steps, self.action_key, self.out_key = steps, nested_key(action_key), out_key

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return that there was no action yet."""
        space = self.action_space
        shape = (*data.batch_size, *space.agents, self.steps * space.size)
        return {self.out_key: torch.zeros(shape, dtype=space.dtype, device=space.spec.device)}

    def act(self, data: TensorDictBase, state: State) -> State:
        """Keep the action that was chosen."""
        newest = self.action_space.vectors(data[self.action_key])
        actions = state[self.out_key][..., : -newest.shape[-1]]
        return {self.out_key: torch.cat([newest, actions], -1)}

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """The actions, which are observed."""
        space, env = self.action_space, self.parent
        shape = (*env.batch_size, *space.agents, self.steps * space.size)
        return {self.out_key: Unbounded(shape, device=env.device, dtype=space.dtype)}
