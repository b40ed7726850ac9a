"""The agent's own last actions as an observation, for envs in which actions take effect late."""

from __future__ import annotations

from functools import cached_property

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded

from coil_rl.transforms.action_space import ChosenActionTransform, nested_key


class LastAction(ChosenActionTransform):
    """Writes the actions that the agent chose in the steps before, newest first.

    TorchRL's transform of this name writes the action that the env was given, which may be another
    one. This one belongs to the method, behind `GuideActions`: an agent observes it wherever it
    drives, whether actions are late there or not.

    Args:
        steps: number of actions, at least 1: as many as may be on their way.
        action_key: entry of the action.
        out_key: entry for the actions as numbers, [*batch, steps * A], one-hot for choices; with an
            action for each of several agents [*batch, n_agents, steps * A]. 0 for no action yet.

    Raises:
        ValueError: for a number of steps outside its range.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> cars = ConeTrackEnv(shipped_tracks("train"), num_envs=8)
        >>> env = TransformedEnv(cars, LastAction(steps=2))
        >>> env.reset()["last_action"].shape
        torch.Size([8, 2])
    """

    chosen_key = "chosen_action"
    needs_past = True  # stored data of a single step are not enough

    def __init__(
        self,
        steps: int = 1,
        action_key: NestedKey = "action",
        out_key: NestedKey = "last_action",
    ) -> None:
        if not 1 <= steps <= 1000:
            raise ValueError(f"steps={steps} must be at least 1 and at most 1000 actions")
        out_key = nested_key(out_key)
        super().__init__(in_keys=[], out_keys=[out_key])
        self.steps, self.action_key, self.out_key = steps, nested_key(action_key), out_key

    @cached_property
    def observation_at_start(self) -> Tensor:
        """The entry at the start of an episode, [*batch, ...]."""
        return self._spec().zero()

    def shifted(self, actions: Tensor, newest: Tensor) -> Tensor:
        """Return the entry after a further action.

        Args:
            actions: the entry before, [..., steps * A].
            newest: the action as a vector, [..., A].
        """
        return torch.cat([newest, actions[..., : -newest.shape[-1]]], -1)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        newest = self.chosen_vectors(tensordict)
        return next_tensordict.set(self.out_key, self.shifted(tensordict[self.out_key], newest))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.set(self.out_key, self.observation_at_start)

    def _spec(self) -> TensorSpec:
        space, env = self.action_space, self.parent
        shape = (*env.batch_size, *space.agents, self.steps * space.size)
        return Unbounded(shape, device=env.device, dtype=space.dtype)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the entry."""
        observation_spec[self.out_key] = self._spec()
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the entry, which is an input of steps."""
        state = input_spec["full_state_spec"] or Composite(
            shape=input_spec.shape, device=input_spec.device
        )
        state[self.out_key] = self._spec()
        input_spec["full_state_spec"] = state
        return input_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return stored data unchanged."""
        return tensordict
