"""Conversion between the actions of an env and vectors of numbers.

Guides, networks and losses compute with vectors. The env may take a vector, the index of a choice,
or several choices at once, for one agent or for several. This is the only file that knows about
these kinds of actions.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, TypeAlias, TypeVar

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
    Unbounded,
)
from torchrl.envs import EnvBase

from coil_rl.transforms.link import Link
from coil_rl.transforms.normalised_action import ActionUnits, given_units, units_of

Key = TypeVar("Key", NestedKey, NestedKey | None)
# What converts entries from the form of networks to that of the env, where it is another, by entry.
OwnForms: TypeAlias = Mapping[NestedKey, Callable[[Tensor], Tensor]]


def nested_key(key: Key) -> Key:
    """Return the key of an entry as TensorDict takes it; YAML has lists for tuples."""
    return key if key is None or isinstance(key, str) else unravel_key(tuple(key))


def written_key(key: NestedKey) -> str:
    """Return the key of an entry as a command takes it, such as `[observation,"0"]`."""
    if not isinstance(key, str):
        return f"[{','.join(map(written_key, key))}]"
    return (
        key
        if re.fullmatch(r"[a-z_][\w./-]*", key, re.A | re.I)
        else json.dumps(key, ensure_ascii=False)
    )


class ActionRange:
    """The numbers that an action may have, in the unit and numbering of its env.

    Args:
        low: lowest ones, [*A]; of choices the number of the first of each, [n].
        high: highest ones, of the same shape.
        whole: whether they are choices.
    """

    def __init__(self, low: Any, high: Any, *, whole: bool) -> None:
        self.low, self.high = (torch.as_tensor(side).cpu().double() for side in (low, high))
        self.whole = whole

    def __str__(self) -> str:
        """Return the range as text, such as "from [-1.0] to [1.0]"."""
        shown = f"from {self.low.tolist()} to {self.high.tolist()}"
        return f"{shown} in whole numbers" if self.whole else shown

    def same_as(self, other: ActionRange) -> bool:
        """Return whether an action has the same numbers, up to rounding."""
        if self.whole != other.whole or self.low.shape != other.low.shape:
            return False
        # Of the distance between the bounds, which may be in any unit.
        rounding = 1e-6 * (self.high - self.low).nan_to_num(posinf=0)
        sides = ((self.low, other.low), (self.high, other.high))
        return all(
            bool(((own == their) | ((own - their).abs() <= rounding)).all()) for own, their in sides
        )


class ActionSpace:
    """Actions of an env as vectors [*batch, *agents, A].

    A discrete action is one-hot, A is the number of choices. Several discrete actions
    (MultiCategorical, MultiOneHot, Binary) are their one-hot vectors side by side.

    Args:
        spec: of the action. A single action without a dimension of its own, or one of whole numbers
            that are no choices, is a `ValueError`.
        batch_dims: number of batch dimensions of the env.
        first: lowest number of each choice, as controllers count them, [n]; None: 0.
        own_shape: shape of an action as controllers give it; None: that of `spec`.

    Attributes:
        units: of its vectors, which are those of `spec`; None for choices.
    """

    def __init__(
        self,
        spec: TensorSpec,
        batch_dims: int,
        first: Tensor | None = None,
        own_shape: Sequence[int] | None = None,
    ) -> None:
        self.spec, self.own_shape = spec, own_shape
        self.event = spec.shape[batch_dims:]
        self.continuous = spec.dtype.is_floating_point
        self.dtype = spec.dtype if self.continuous else torch.float32
        self.choices = choices_of(spec)
        if not self.choices and not (self.continuous and self.event):
            raise ValueError(
                f"advice needs a vector of real numbers or choices, but the env's action is {spec}"
            )
        self.size = sum(self.choices) or spec.shape[-1]
        self.one_hot = isinstance(spec, OneHot)
        # An index may have a dimension of its own.
        self.indexed = bool(self.choices) and not self.one_hot
        own = not self.indexed or len(self.choices) > 1 or self.event[-1:] == (1,)
        self.agents = self.event[:-1] if own else self.event
        self.first = first if self.indexed else None
        self.units = units_of(spec, batch_dims) if self.continuous else None
        self.bounds: tuple[Tensor, Tensor] | None = None
        if self.units is not None and isinstance(spec, Bounded):
            self.bounds = self.units.bounds

    @property
    def range(self) -> ActionRange:
        """The numbers that an action may have; infinite ones without bounds."""
        if self.choices:
            number = torch.tensor(self.choices)
            low = torch.zeros_like(number) if self.first is None else self.first.cpu()
            return ActionRange(low, low + number - 1, whole=True)
        infinite = torch.full(self.event, torch.inf)
        return ActionRange(*(self.bounds or (-infinite, infinite)), whole=False)

    def normalise(self, vectors: Tensor) -> Tensor:
        """Return vectors [..., A] in normalised numbers; those of choices stay as they are."""
        return vectors if self.units is None else self.units.normalise(vectors)

    def denormalise(self, vectors: Tensor) -> Tensor:
        """Return normalised vectors [..., A] in the unit of the action, within its bounds."""
        return vectors if self.units is None else self.units.denormalise(vectors)

    def added(self, vectors: Tensor, others: Tensor, scale: float) -> Tensor:
        """Return vectors plus `scale` times others, added in normalised numbers and clamped.

        Args:
            vectors: [..., A].
            others: [..., A].
        """
        if self.units is None or self.units.identity:
            return self.clamp(vectors + scale * others)
        return self.denormalise(self.normalise(vectors) + scale * self.normalise(others))

    def mirrored(self, vectors: Tensor) -> Tensor:
        """Return the opposite of vectors [..., A]: of choices their reverse order."""
        if self.units is not None:
            return self.denormalise(-self.normalise(vectors))
        return torch.cat([part.flip(-1) for part in vectors.split(self.choices, -1)], -1)

    def neutral(self) -> Tensor:
        """Return the vector [*agents, A] of the centre of the action, or of first choices."""
        if self.units is not None:
            return self.denormalise(torch.zeros_like(self.units.centre))
        indices = torch.zeros(*self.agents, len(self.choices), dtype=torch.int64)
        return self._encoded(indices.to(self.spec.device)).to(self.dtype)

    def random(self, draws: Tensor) -> Tensor:
        """Return vectors that are uniform in the action, for uniform numbers from 0 to 1 [..., A].

        A coordinate without a bound is uniform in one unit to each side of its centre. Of choices
        the one with the largest number is taken.
        """
        if self.units is not None:
            return self.denormalise(-1.0 + 2.0 * draws)
        parts = [part.argmax(-1) for part in draws.split(self.choices, -1)]
        return self._encoded(torch.stack(parts, -1)).to(self.dtype)

    def vectors(self, action: Tensor) -> Tensor:
        """Convert env actions to vectors [*batch, *agents, A]."""
        if self.indexed:
            batch = action.shape[: action.ndim - len(self.event)]
            action = self._encoded(action.reshape(*batch, *self.agents, len(self.choices)))
        return action if action.dtype.is_floating_point else action.to(self.dtype)

    def advice(self, action: Tensor, batch: torch.Size) -> Tensor:
        """Convert the action of a guide to a vector within the bounds of the env's action.

        Args:
            action: [*batch, *agents, A], for choices also their indices; another shape is a
                `ValueError`.
        """
        action = self._as_vector(action, batch)
        indices = self._indices(action, batch)
        vectors = action if indices is None else self._encoded(indices)
        return self.clamp(vectors.to(self.dtype))

    def check_advice(self, action: Tensor, batch: torch.Size) -> None:
        """Raise a `ValueError` for a guide's action that does not fit the env.

        It has another shape, or numbers that no action of the env has.
        """
        action = self._as_vector(action, batch)
        indices = self._indices(action, batch)
        if not action.isfinite().all():
            raise ValueError("holds a number that is not finite")
        if not self.choices:
            return
        # The elements of a vector are 0 or 1.
        limit = torch.tensor(2 if indices is None else self.choices, device=action.device)
        numbers = action if indices is None else indices
        if not ((numbers >= 0) & (numbers < limit)).all():
            low, high = (side.long().tolist() for side in (self.range.low, self.range.high))
            raise ValueError(f"is neither a number from {low} to {high} nor a one-hot vector")
        if not (numbers == numbers.long()).all():
            raise ValueError("is no whole number, but must be the number of a choice")
        if indices is None and self.size > len(self.choices):
            chosen = torch.stack([part.sum(-1) for part in action.split(self.choices, -1)], -1)
            if (chosen != 1).any():
                raise ValueError("is no one-hot vector: it must have exactly one 1 for each choice")

    def takes(self, action: Tensor, batch: torch.Size) -> bool:
        """Return whether the action of a guide has a shape of which `advice` makes a vector."""
        try:
            self._indices(self._as_vector(action, batch), batch)
        except ValueError:
            return False
        return True

    def as_column(self, action: Tensor, batch: torch.Size) -> Tensor:
        """Return an action [*batch, 1] where a controller gave one number for each row, [*batch].

        Anything else is returned as it is, and so is it where an action is more than one number.
        """
        is_number = self.continuous and self.event.numel() == 1
        return action.reshape(*batch, 1) if is_number and action.shape == batch else action

    def unfit_row(self, action: Tensor, batch: torch.Size) -> tuple[int, Tensor, str]:
        """Return the first row whose action does not fit the env, and the reason.

        Args:
            action: of the guide, [*batch, ...].

        Returns:
            The number of the row, its action, and what `check_advice` says of it; of row 0 if each
            row alone would fit.
        """
        rows = action.reshape(batch.numel(), *action.shape[len(batch) :])
        for number, row in enumerate(rows):
            try:
                self.check_advice(row, torch.Size([]))
            except ValueError as error:
                return number, row, str(error)
        return 0, rows[0], "does not fit the env"

    def _as_vector(self, action: Tensor, batch: torch.Size) -> Tensor:
        """Return a guide's action as a vector [*batch, A] if it has the shape of controllers."""
        if self.own_shape is None or action.shape != (*batch, *self.own_shape):
            return action
        return action.reshape(*batch, self.size)

    def _indices(self, action: Tensor, batch: torch.Size) -> Tensor | None:
        """Return the choices of a guide as indices [*batch, *agents, n].

        None if they are vectors already.
        """
        lead = (*batch, *self.agents)
        if action.shape == (*lead, self.size):
            return None
        n = len(self.choices)
        if (n and action.shape == (*lead, n)) or (n == 1 and action.shape == lead):
            indices = action.reshape(*lead, n)
            return indices if self.first is None else indices - self.first.to(indices)
        expected = [*lead, self.size] if self.own_shape is None else [*batch, *self.own_shape]
        raise ValueError(f"has the shape {list(action.shape)}, but must have {expected}")

    def actions(self, vectors: Tensor) -> Tensor:
        """Convert vectors [*batch, *agents, A] to env actions; a discrete action is the argmax."""
        if self.continuous:
            return vectors
        best = torch.stack([part.argmax(-1) for part in vectors.split(self.choices, -1)], -1)
        if self.one_hot:
            return self._encoded(best).to(self.spec.dtype)
        batch = vectors.shape[: vectors.ndim - 1 - len(self.agents)]
        return best.reshape((*batch, *self.event)).to(self.spec.dtype)

    def executed(self, action: Tensor) -> Tensor:
        """Return an action of the env [*batch, *A] within its bounds, in the numbering of it."""
        if self.continuous:
            return self.clamp(action)
        if self.first is None:
            return action
        return action + self.first.to(action).reshape(self.event)

    def _encoded(self, indices: Tensor) -> Tensor:
        """Return the one-hot vectors of indices [..., n] side by side."""
        parts = [
            F.one_hot(index, n)
            for index, n in zip(indices.long().unbind(-1), self.choices, strict=True)
        ]
        return parts[0] if len(parts) == 1 else torch.cat(parts, -1)

    def clamp(self, vectors: Tensor) -> Tensor:
        """Clamp vectors [*batch, *agents, A] to the bounds of the action, if it has any."""
        return vectors if self.bounds is None else vectors.clamp(*self.bounds)

    def advice_spec(self, batch: torch.Size, guides: int) -> TensorSpec:
        """Return the spec of advice [*batch, *agents, guides, A].

        Its bounds are those of the action, or 0 and 1 for one-hot vectors.
        """
        shape, device = (*batch, *self.agents, guides, self.size), self.spec.device
        if not self.continuous:
            return Bounded(0, 1, shape, device=device, dtype=self.dtype)
        if self.bounds is None:
            return Unbounded(shape, device=device, dtype=self.dtype)
        low, high = (bound.unsqueeze(-2).expand(shape) for bound in self.bounds)
        return Bounded(low, high, shape, device=device, dtype=self.dtype)


class ActionTransform(Link):
    """Base class of transforms that use the action of their env."""

    action_key: NestedKey

    @cached_property
    def action_space(self) -> ActionSpace:
        """Action space of the env; RuntimeError outside an env."""
        env = self.parent  # slow, TorchRL rebuilds the env
        if env is None:
            raise RuntimeError(
                f"{type(self).__name__} needs the action spec of an env: use it in a TransformedEnv"
            )
        return ActionSpace(env.full_action_spec[self.action_key], env.batch_dims)

    @cached_property
    def given_units(self) -> ActionUnits | None:
        """Units in which the env gets the action, None if they are those of its spec."""
        return given_units(self.parent)

    def observed(self, vectors: Tensor) -> Tensor:
        """Return vectors [..., A] in the unit of the env as the agent sees them, within bounds."""
        if self.given_units is not None:
            vectors = self.given_units.normalise(vectors)
        return self.action_space.clamp(vectors)


def own_forms(env: EnvBase) -> OwnForms:
    """Return what converts entries from the form of networks to that of the env, by entry."""
    return getattr(env, "own_forms", {})


def space_of(env: EnvBase, action_key: NestedKey) -> ActionSpace:
    """Return the action space of an env without transforms, as its controllers see it.

    Args:
        env: without transforms.
        action_key: entry of the action.
    """
    first, shape = getattr(env, "first_choices", None), getattr(env, "own_shape", None)
    return ActionSpace(env.full_action_spec[action_key], env.batch_dims, first, shape)


def random_action(env: EnvBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Write a random action of an env: uniform, see `ActionSpace.random`.

    Args:
        tensordict: of the env, [*batch].
    """
    spec = env.full_action_spec[env.action_key]
    bounded = isinstance(spec, Bounded) and (spec.space.high - spec.space.low).isfinite().all()
    if bounded or not spec.dtype.is_floating_point:
        # TorchRL's `rand_action` draws the same, and imports pandas where that is installed.
        return tensordict.set(env.action_key, spec.rand())
    draws = torch.rand(spec.shape, dtype=spec.dtype, device=spec.device)
    return tensordict.set(env.action_key, ActionSpace(spec, env.batch_dims).random(draws))


def choices_of(spec: TensorSpec) -> list[int]:
    """Return the number of choices of each discrete action of a spec; an empty list without any."""
    if isinstance(spec, Binary):
        return [2] * spec.shape[-1]
    if isinstance(spec, MultiCategorical):
        return spec.nvec.reshape(-1, spec.nvec.shape[-1])[0].tolist()
    if isinstance(spec, MultiOneHot):
        return list(spec.nvec)
    if isinstance(spec, (Categorical, OneHot)):
        return [int(spec.space.n)]
    return []
