"""Discrete actions for an env with one bounded continuous action.

DQN and other methods choose among a few actions. The guides of a continuous env go on to advise
numbers; only the agent sees choices.
"""

import itertools
import math
from collections.abc import Sequence
from functools import cached_property

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Categorical, Composite

from coil_rl.transforms.action_space import ActionSpace, ActionTransform
from coil_rl.transforms.link import State


class DiscreteActions(ActionTransform):
    """Discretise the action, and round the advice to the nearest choice.

    The agent's action becomes the index of a choice, and the advice becomes one-hot. Place it last:
    the transforms before it and the env work with numbers, with the advice as given, not
    rounded.

    Args:
        choices: number of choices, equally spaced from bound to bound, or the values in the unit of
            the env.
        action_key: entry of the action, one bounded number; becomes [*batch], int64.
        advice_key: entry of the advice, if any, [*batch, n_guides, 1]; becomes [*batch, n_guides,
            n], 0 or 1.
        number_key: entry for the advice as numbers, [*batch, n_guides, 1].

    Raises:
        ValueError: for fewer than two choices, and for values that are not finite and increasing;
            in an env also for an action of another kind, and for values outside its bounds.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> cars = ConeTrackEnv(shipped_tracks("train"), num_envs=8)
        >>> env = TransformedEnv(cars, DiscreteActions(5))
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
            raise ValueError(f"choices={list(choices)} must be at least two increasing numbers")
        elif not all(map(math.isfinite, choices)):
            raise ValueError(f"choices={list(choices)} must be finite")
        self.choices = choices
        self.action_key, self.advice_key, self.number_key = action_key, advice_key, number_key

    @cached_property
    def values(self) -> Tensor:
        """[n], values of the choices in the unit of the agent; RuntimeError outside an env."""
        space, spec, units = self.action_space, self.action_space.spec, self.given_units
        if not space.continuous:
            raise ValueError(
                "DiscreteActions makes choices of one number, but the action of this env is "
                f"choices already ({type(spec).__name__}); leave it out: action=continuous"
            )
        size, bounds = space.event.numel(), space.bounds
        if size != 1 or bounds is None or not torch.stack(bounds).isfinite().all():
            found = f"{size} numbers" if size != 1 else type(spec).__name__
            raise ValueError(
                "DiscreteActions needs an action of one bounded number, but this env's action is "
                f"{found}; leave it out: action=continuous, with another learner than DQN"
            )
        if isinstance(self.choices, int):
            low, high = map(float, bounds)
            return torch.linspace(low, high, self.choices, dtype=spec.dtype, device=spec.device)
        low, high = map(float, units.bounds if units else bounds)
        if self.choices[0] < low or self.choices[-1] > high:
            raise ValueError(
                f"choices={list(self.choices)} must lie between the action's bounds {low} and "
                f"{high}"
            )
        values = torch.tensor(self.choices, dtype=spec.dtype, device=spec.device)
        return units.normalise(values) if units else values

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the advice as the nearest choices, one-hot, and as numbers, where there is any."""
        numbers = data.get(self.advice_key, None)
        if numbers is not None:
            nearest = (numbers - self.values).abs().argmin(-1)  # of two the lower one
            choices = F.one_hot(nearest, len(self.values)).to(numbers.dtype)
            data.set(self.number_key, numbers).set(self.advice_key, choices)
        return state

    def act(self, data: TensorDictBase, state: State) -> State:
        """Write the number of the choice, and the advice as numbers again."""
        numbers = data.get(self.number_key, None)
        if numbers is not None:
            data.set(self.advice_key, numbers)
        data.set(self.action_key, self.values[data[self.action_key]].unsqueeze(-1))
        return state

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Replace the action spec."""
        input_spec["full_action_spec", self.action_key] = self._action_spec()
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Replace the spec of the advice and add `number_key`."""
        numbers = observation_spec.get(self.advice_key, None)
        if numbers is not None:
            space = ActionSpace(self._action_spec(), self.parent.batch_dims)
            observation_spec[self.number_key] = numbers
            observation_spec[self.advice_key] = space.advice_spec(
                self.parent.batch_size, numbers.shape[-2]
            )
        return observation_spec

    def _action_spec(self) -> Categorical:
        return Categorical(
            len(self.values), self.parent.batch_size, device=self.values.device, dtype=torch.int64
        )
