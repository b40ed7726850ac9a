"""The normalised action: what agents compute with, whatever unit their env has.

A bounded coordinate goes from -1 to 1 between its bounds. Where a bound is missing, the unit is
that of the env: a coordinate with one bound has -1 or 1 there and no limit on the other side, and
one without bounds stays as it is. Choices have one numbering, see `ActionSpace`.

The env and its guides speak the env's unit. Between them and everything else stand
`NormalisedAction`, next to the env, and `GuideActions`.
"""

from __future__ import annotations

from functools import cached_property

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import EnvBase, Transform

from coil_rl.transforms.link import Link, State

LARGEST_BOUND = 1e30  # beyond it a bound is none: the largest number of a type stands for infinity
WIDTH = 2.0  # assumed from the only bound of a coordinate
# Names of the bounds that a coordinate lacks, by whether it has a lower and an upper one.
MISSING = {
    (True, False): "no upper bound",
    (False, True): "no lower bound",
    (False, False): "no bounds",
}


class ActionUnits:
    """Centre and unit of each coordinate of an action, and the map to normalised numbers.

    Args:
        low: lower bounds [*A], infinite where there is none.
        high: upper bounds [*A], infinite where there is none.

    Attributes:
        centre: [*A], what 0 stands for.
        unit: [*A], what 1 stands for, from the centre.
        low: [*A], lower bounds of normalised numbers.
        high: [*A], upper bounds of normalised numbers.
        identity: whether normalised numbers are those of the env.

    Raises:
        ValueError: if a lower bound is not below its upper one.
    """

    def __init__(self, low: Tensor, high: Tensor) -> None:
        if not (low < high).all():
            raise ValueError(
                f"the action has the lower bounds {low.tolist()} and the upper bounds "
                f"{high.tolist()}, but each lower one must be below the upper one"
            )
        has_low, has_high = low > -LARGEST_BOUND, high < LARGEST_BOUND
        lowest = torch.where(has_low, low, torch.where(has_high, high - WIDTH, -WIDTH / 2))
        highest = torch.where(has_high, high, lowest + WIDTH)
        # Halved first, as the sum or difference of two large numbers may be infinite.
        self.centre = lowest / 2 + highest / 2
        self.unit = highest / 2 - lowest / 2
        self.low = torch.where(has_low, -1.0, -torch.inf).to(low.dtype)
        self.high = torch.where(has_high, 1.0, torch.inf).to(low.dtype)
        self.bounds = low, high
        self.identity = bool(((self.centre == 0) & (self.unit == 1)).all())

    def normalise(self, numbers: Tensor) -> Tensor:
        """Return normalised numbers [..., *A] for numbers in the unit of the env."""
        return numbers if self.identity else (numbers - self.centre) / self.unit

    def denormalise(self, numbers: Tensor) -> Tensor:
        """Return numbers [..., *A] in the unit of the env, within its bounds."""
        given = numbers if self.identity else self.centre + self.unit * numbers
        return given.clamp(*self.bounds)

    @property
    def assumed(self) -> list[str]:
        """For each coordinate without one of its bounds a phrase that says its unit."""
        phrases = []
        rows = zip(self.low.flatten(), self.high.flatten(), self.centre.flatten(), strict=True)
        for index, (low, high, centre) in enumerate(rows):
            if missing := MISSING.get((bool(low.isfinite()), bool(high.isfinite()))):
                unit = f"it counts in units of 1 around {centre:g}"
                phrases.append(f"coordinate {index} has {missing}: {unit}")
        return phrases


def units_of(spec: TensorSpec, batch_dims: int) -> ActionUnits | None:
    """Return the units of an action; None for choices.

    Args:
        batch_dims: number of batch dimensions of the env.
    """
    if not spec.dtype.is_floating_point:
        return None
    if not isinstance(spec, Bounded):
        infinite = torch.full(
            spec.shape[batch_dims:], torch.inf, dtype=spec.dtype, device=spec.device
        )
        return ActionUnits(-infinite, infinite)
    first = (0,) * batch_dims
    return ActionUnits(spec.space.low[first], spec.space.high[first])


class NormalisedAction(Link):
    """Normalise the action of an env, see above. Place it first, next to the env.

    All transforms behind it, and the agent, then see actions and advice that are normalised; guides
    go on to speak the unit of the env.

    Args:
        action_key: entry of the action; one of choices is left as it is.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl import GymnasiumEnv
        >>> env = TransformedEnv(GymnasiumEnv("Pendulum-v1"), NormalisedAction())
        >>> float(env.base_env.action_spec.space.high), float(env.action_spec.space.high)
        (2.0, 1.0)
    """

    def __init__(self, action_key: NestedKey = "action") -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.action_key = action_key

    @cached_property
    def units(self) -> ActionUnits | None:
        """Units of the env's action, None for choices; a RuntimeError outside an env."""
        env = self.parent
        if env is None:
            raise RuntimeError("NormalisedAction needs an env: use it in a TransformedEnv")
        units = units_of(env.full_action_spec[self.action_key], env.batch_dims)
        links = (each for each in env.modules() if isinstance(each, Link))
        before = [type(each).__name__ for each in links if hasattr(each, "action_key")]
        if before and units is not None and not units.identity:
            raise ValueError(
                f"NormalisedAction is behind {before[0]}, whose actions would be in another unit; "
                "place it first, next to the env"
            )
        return units

    def act(self, data: TensorDictBase, state: State) -> State:
        """Write the action in the unit of the env."""
        if self.units is not None:
            data.set(self.action_key, self.units.denormalise(data[self.action_key]))
        return state

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Replace the spec of the action."""
        units, spec = self.units, input_spec["full_action_spec", self.action_key]
        if units is not None and not units.identity:
            input_spec["full_action_spec", self.action_key] = Bounded(
                units.low.expand(spec.shape),
                units.high.expand(spec.shape),
                spec.shape,
                device=spec.device,
                dtype=spec.dtype,
            )
        return input_spec


def normalising(env: EnvBase) -> list[Transform]:
    """Return the transform that normalises the action of an env; none if that changes nothing.

    Args:
        env: without transforms of a method; actions that are not one entry are left as they are.
    """
    if len(env.action_keys) != 1:
        return []
    key = env.action_key
    units = units_of(env.full_action_spec[key], env.batch_dims)
    if units is None or units.identity:
        return []
    return [NormalisedAction(key)]


def given_units(env: EnvBase) -> ActionUnits | None:
    """Return the units in which an env gets its action behind `NormalisedAction`.

    None if nothing in it normalises: then they are those of its own spec.
    """
    for module in env.modules():
        if isinstance(module, NormalisedAction):
            return module.units
    return None


class Denormalised(TensorDictModuleBase):
    """A policy of an env with normalised actions as a guide, which acts in the unit of the env.

    Args:
        policy: writes `action`, normalised.
        units: of the env.
    """

    def __init__(self, policy: TensorDictModuleBase, units: ActionUnits) -> None:
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        super().__init__()
        self.policy, self.units = policy, units

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        tensordict = self.policy(tensordict)
        return tensordict.set("action", self.units.denormalise(tensordict["action"]))


def in_unit_of(env: EnvBase, policy: TensorDictModuleBase) -> TensorDictModuleBase:
    """Return a policy as a guide that acts in the unit of an env.

    Args:
        env: with the transforms for which the policy was made.
    """
    units = given_units(env)
    return policy if units is None else Denormalised(policy, units)
