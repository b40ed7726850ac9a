"""Conversion between the actions of an env and vectors of numbers.

Guides, networks and losses compute with vectors. The env may take a vector, the index of a choice,
or several choices at once, for one agent or for several. This is the only file that knows about
these kinds of actions.
"""

from __future__ import annotations

from functools import cached_property
from typing import TypeVar

import torch
from tensordict import NestedKey, unravel_key
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
from torchrl.envs import Transform

Key = TypeVar("Key", NestedKey, NestedKey | None)


def nested_key(key: Key) -> Key:
    """Return the key of an entry as TensorDict takes it; YAML has lists for tuples."""
    return key if key is None or isinstance(key, str) else unravel_key(tuple(key))


class ActionSpace:
    """Actions of an env as vectors [*batch, *agents, A].

    A discrete action is one-hot, A is the number of choices. Several discrete actions
    (MultiCategorical, MultiOneHot, Binary) are their one-hot vectors side by side.

    Args:
        spec: of the action. A single action without a dimension of its own, or one of whole numbers
            that are no choices, is a `ValueError`.
        batch_dims: number of batch dimensions of the env.
    """

    def __init__(self, spec: TensorSpec, batch_dims: int) -> None:
        self.spec = spec
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
        self.bounds: tuple[Tensor, Tensor] | None = None
        if isinstance(spec, Bounded):
            first = (0,) * batch_dims
            self.bounds = spec.space.low[first], spec.space.high[first]

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
            batch: of the action.
        """
        indices = self._indices(action, batch)
        vectors = action if indices is None else self._encoded(indices)
        return self.clamp(vectors.to(self.dtype))

    def check_advice(self, action: Tensor, batch: torch.Size) -> None:
        """Raise a `ValueError` for a guide's action that does not fit the env.

        It has another shape, or numbers that no action of the env has.

        Args:
            action: of the guide.
            batch: of the action.
        """
        indices = self._indices(action, batch)
        if not action.isfinite().all():
            raise ValueError("holds a number that is not finite")
        if self.choices:
            # The elements of a vector are 0 or 1.
            limit = torch.tensor(2 if indices is None else self.choices, device=action.device)
            numbers = action if indices is None else indices
            fits = (numbers >= 0) & (numbers < limit)
            if indices is not None and action.dtype.is_floating_point:
                fits &= numbers == numbers.floor()
            if not fits.all():
                raise ValueError(
                    f"is neither an index below {max(self.choices)} nor a one-hot vector"
                )

    def _indices(self, action: Tensor, batch: torch.Size) -> Tensor | None:
        """Return the choices of a guide as indices [*batch, *agents, n].

        None if they are vectors already.
        """
        lead = (*batch, *self.agents)
        if action.shape == (*lead, self.size):
            return None
        n = len(self.choices)
        if (n and action.shape == (*lead, n)) or (n == 1 and action.shape == lead):
            return action.reshape(*lead, n)
        raise ValueError(f"has the shape {list(action.shape)}, but must have {[*lead, self.size]}")

    def actions(self, vectors: Tensor) -> Tensor:
        """Convert vectors [*batch, *agents, A] to env actions; a discrete action is the argmax."""
        if self.continuous:
            return vectors
        best = torch.stack([part.argmax(-1) for part in vectors.split(self.choices, -1)], -1)
        if self.one_hot:
            return self._encoded(best).to(self.spec.dtype)
        batch = vectors.shape[: vectors.ndim - 1 - len(self.agents)]
        return best.reshape((*batch, *self.event)).to(self.spec.dtype)

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

        Args:
            batch: of the env.
            guides: number of guides.
        """
        shape, device = (*batch, *self.agents, guides, self.size), self.spec.device
        if not self.continuous:
            return Bounded(0, 1, shape, device=device, dtype=self.dtype)
        if self.bounds is None:
            return Unbounded(shape, device=device, dtype=self.dtype)
        low, high = (bound.unsqueeze(-2).expand(shape) for bound in self.bounds)
        return Bounded(low, high, shape, device=device, dtype=self.dtype)


class ActionTransform(Transform):
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
