"""Choices in place of numbers: the agent picks one of a few actions of an env that takes a number."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Bounded, Categorical, Composite
from torchrl.envs import Transform

from coil_rl.transforms.action_space import ActionSpace


class DiscreteActions(Transform):
    """Gives an agent a few values of an action to choose from, and advice as the nearest of them.

    The agent's action becomes the number of its choice, and of the advice it sees which choice is nearest, one-hot. It
    stands last: whatever stands before it, and the env, has numbers in action units as without it. A residual agent
    adds its choice to what the guide really advises, a guide that takes over is not rounded, and the distance that
    `RewardCoupling` charges for is the one between the number chosen and the number advised.

    Args:
        choices: how many, equally spaced from bound to bound, or the numbers themselves.
        action_key: the action, one bounded number; becomes [*batch], int64.
        advice_key: the advice, [*batch, n_guides, 1], if there is any; becomes [*batch, n_guides, n], 0 or 1.
        number_key: where the advice stays as it was, [*batch, n_guides, 1].

    Raises:
        ValueError: for fewer than two choices, choices that are not finite or do not rise, and, as soon as it belongs
            to an env, for an action of another kind or a choice beyond its bounds.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> env = TransformedEnv(ConeTrackEnv(shipped_tracks("train"), num_cars=8), DiscreteActions(5))
        >>> env.action_spec.n, env.transform.values.tolist()
        (5, [-1.0, -0.5, 0.0, 0.5, 1.0])
    """

    def __init__(
        self,
        choices: int | Sequence[float] = 5,
        action_key: NestedKey = "action",
        advice_key: NestedKey = "guide_action",
        number_key: NestedKey = "guide_number",
    ) -> None:
        super().__init__(in_keys=[], out_keys=[])
        if isinstance(choices, int):
            if choices < 2:
                raise ValueError(f"choices={choices} must be at least 2")
        elif len(choices) < 2 or not all(low < high for low, high in itertools.pairwise(choices)):
            raise ValueError(f"choices={list(choices)} must be at least two numbers, each more than the one before it")
        elif not all(map(math.isfinite, choices)):
            raise ValueError(f"choices={list(choices)} must be finite")
        self.choices = choices
        self.action_key, self.advice_key, self.number_key = action_key, advice_key, number_key
        self._values: Tensor | None = None

    @property
    def values(self) -> Tensor:
        """[n], what each choice stands for, in action units.

        Raises:
            RuntimeError: outside an env.
        """
        if self._values is None:
            if self.parent is None:
                raise RuntimeError("DiscreteActions works inside a TransformedEnv only: it needs the env's action spec")
            self._values = self._of(self.parent.full_action_spec[self.action_key])
        return self._values

    def _of(self, spec: Bounded) -> Tensor:
        size = spec.shape[self.parent.batch_dims :].numel()
        if not isinstance(spec, Bounded) or not spec.dtype.is_floating_point or size != 1:
            kind = f"{size} numbers" if spec.dtype.is_floating_point and size != 1 else type(spec).__name__
            raise ValueError(
                f"DiscreteActions makes choices of one number between bounds, but this env's action is {kind}"
            )
        low, high = (float(bound.flatten()[0]) for bound in (spec.space.low, spec.space.high))
        if isinstance(self.choices, int):
            return torch.linspace(low, high, self.choices, dtype=spec.dtype, device=spec.device)
        if self.choices[0] < low or self.choices[-1] > high:
            raise ValueError(f"choices={list(self.choices)} must lie between the action's bounds {low} and {high}")
        return torch.tensor(self.choices, dtype=spec.dtype, device=spec.device)

    def nearest(self, numbers: Tensor) -> Tensor:
        """Numbers [..., 1] to the number of the choice that is nearest, [...]; between two the lower one."""
        return (numbers - self.values).abs().argmin(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Make choices of the advice in stored data, of any batch size."""
        return self._call(tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        numbers = next_tensordict.get(self.advice_key, None)
        if numbers is None:
            return next_tensordict
        choices = F.one_hot(self.nearest(numbers), len(self.values)).to(numbers.dtype)
        return next_tensordict.set(self.number_key, numbers).set(self.advice_key, choices)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        numbers = tensordict.get(self.number_key, None)
        if numbers is not None:
            tensordict.set(self.advice_key, numbers)
        return tensordict.set(self.action_key, self.values[tensordict[self.action_key]].unsqueeze(-1))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Make the action a choice."""
        input_spec["full_action_spec", self.action_key] = self._action_spec()
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Make the advice one-hot, beside the advice as it was."""
        numbers = observation_spec.get(self.advice_key, None)
        if numbers is not None:
            space = ActionSpace(self._action_spec(), self.parent.batch_dims)
            observation_spec[self.number_key] = numbers
            observation_spec[self.advice_key] = space.advice_spec(self.parent.batch_size, numbers.shape[-2])
        return observation_spec

    def _action_spec(self) -> Categorical:
        return Categorical(len(self.values), self.parent.batch_size, device=self.values.device, dtype=torch.int64)
