"""What is observed and what is executed, as functions: the base class of the transforms here.

A policy stands at the end of a chain of links. What the env writes goes through them in their
order and is what the policy observes; the action of the policy goes back through them and is what
the env is given. See `Chain`, which applies them without an env.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import EnvBase, Transform

State: TypeAlias = dict[NestedKey, Tensor]  # what a link remembers, by the key of its entry


class Link(Transform):
    """Base class: a transform that is written as `observe` and `act`; TorchRL's methods call them.

    What a link remembers goes in and comes out, so both are functions of their arguments. In an env
    the state is a part of the data, under the keys of `state`.
    """

    needs_past = False  # whether stored data of a single step are not enough
    constant = False  # whether the state stays the same within an episode of an evaluation
    passed: Sequence[NestedKey] = ()  # entries that `act` leaves for the next `observe` only

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """Specs of what is remembered from one step to the next, for the rows of the env."""
        return {}

    @property
    def records(self) -> Mapping[NestedKey, TensorSpec]:
        """Specs of what `act` writes for the data of a run: nothing depends on it; at first 0."""
        return {}

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return the state before the first observation of an episode.

        Args:
            data: of the first step, [*batch], as the links before this one have observed it.
            reset: what an env was asked to reset: `_reset`, and the state of all rows; None outside
                of an env.
        """
        return {}

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write what the policy sees, and return the state, which is written by its keys.

        Args:
            data: what the env and the links before this one have written, [*batch].
            state: of `first`, or of `sent`.
        """
        return state

    def act(self, data: TensorDictBase, state: State) -> State:
        """Replace the action by the one for the link before this one, and return the state.

        Args:
            data: of the step, with the action that the link behind this one has left.
            state: of `observe`.
        """
        return state

    def sent(self, data: TensorDictBase, state: State) -> State:
        """Return the state for the next observation, once the env has got its action.

        Args:
            data: of the step, with the action after all links.
            state: of `act`.
        """
        return state

    @cached_property
    def _keys(self) -> list[NestedKey]:
        """Keys of the state in the data of an env."""
        return [*self.state, *self.passed]

    @cached_property
    def _nothing(self) -> State:
        """What is recorded with the first observation."""
        return {key: spec.zero() for key, spec in self.records.items()}

    def set_container(self, container: Transform | EnvBase) -> None:
        """Set the env, which may have other rows than an earlier one."""
        super().set_container(container)
        for name in [*self.__dict__]:
            if isinstance(getattr(type(self), name, None), cached_property):
                del self.__dict__[name]

    def _of_rows(
        self, kind: Callable[..., TensorSpec], *bounds: float, dtype: torch.dtype
    ) -> TensorSpec:
        """Return the spec of one number for each row of the env, [*batch, 1]."""
        shape = (*self.parent.batch_size, 1)
        return kind(*bounds, shape=shape, device=self.parent.device, dtype=dtype)

    def _entry(self, data: TensorDictBase, key: NestedKey) -> Tensor:
        """Return an entry of the data; zeros where they do not have it yet."""
        if key in data.keys(True, True):
            return data[key]
        zero = self.parent.full_observation_spec[key].zero()
        row = zero[(0,) * self.parent.batch_dims]
        return row.expand(*data.batch_size, *row.shape)

    def _state_in(self, data: TensorDictBase) -> State:
        found = ((key, data.get(key, None)) for key in self._keys)
        return {key: value for key, value in found if value is not None}

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return write(next_tensordict, self.observe(next_tensordict, self.first(next_tensordict)))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        state = self.observe(tensordict_reset, self.first(tensordict_reset, tensordict))
        return write(tensordict_reset, {**self._nothing, **state})

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key in self._nothing:
            next_tensordict.set(key, tensordict[key])
        state = self.sent(tensordict, self._state_in(tensordict))
        return write(next_tensordict, self.observe(next_tensordict, state))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if type(self).act is Link.act:
            return tensordict
        return write(tensordict, self.act(tensordict, self._state_in(tensordict)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what is observed into stored data.

        Raises:
            RuntimeError: if it depends on previous steps, which stored data lack.
        """
        if self.needs_past:
            raise RuntimeError(
                f"{type(self).__name__} needs the previous steps: use it in a TransformedEnv"
            )
        return self._call(tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add what is remembered and recorded."""
        return observation_spec.update({**self.state, **self.records})

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add what is remembered, which is an input of steps."""
        if self.state:
            state = input_spec["full_state_spec"] or Composite(
                shape=input_spec.shape, device=input_spec.device
            )
            input_spec["full_state_spec"] = state.update(dict(self.state))
        return input_spec


def write(data: TensorDictBase, state: State) -> TensorDictBase:
    """Write a state by its keys, and return the data."""
    for key, value in state.items():
        data.set(key, value)
    return data
