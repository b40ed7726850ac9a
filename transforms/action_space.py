"""Actions as vectors of numbers, whatever an env takes."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec, Unbounded


class ActionSpace:
    """One env's actions as vectors [*batch, A]; a choice among n becomes one-hot, with A = n.

    Args:
        spec: of the action.
        batch_dims: of the env.
    """

    def __init__(self, spec: TensorSpec, batch_dims: int) -> None:
        self.spec = spec
        self.event = spec.shape[batch_dims:]
        self.choices = spec.n if isinstance(spec, Categorical) else 0
        self.size = self.choices or spec.shape[-1]
        self.continuous = spec.dtype.is_floating_point
        self.dtype = spec.dtype if self.continuous else torch.float32
        first = (0,) * batch_dims
        self.bounds = (spec.space.low[first], spec.space.high[first]) if isinstance(spec, Bounded) else None

    def vectors(self, action: Tensor) -> Tensor:
        """Actions as the env takes them, to [*batch, A]."""
        if self.choices:
            batch = action.shape[: action.ndim - len(self.event)]
            action = F.one_hot(action.reshape(batch).long(), self.choices)
        return action if action.dtype.is_floating_point else action.to(self.dtype)

    def actions(self, vectors: Tensor) -> Tensor:
        """[*batch, A] to actions as the env takes them: of the choices, the one with the largest number."""
        if self.continuous:
            return vectors
        best = vectors.argmax(-1)
        if isinstance(self.spec, OneHot):
            return F.one_hot(best, self.size).to(self.spec.dtype)
        return best.reshape((*best.shape, *self.event)).to(self.spec.dtype)

    def clamp(self, vectors: Tensor) -> Tensor:
        """[*batch, A] within the bounds of the action, if it has any."""
        return vectors if self.bounds is None else vectors.clamp(*self.bounds)

    def advice_spec(self, batch: torch.Size, guides: int) -> TensorSpec:
        """Of [*batch, guides, A]: bounded like the action, and within 0 and 1 where it is one-hot."""
        shape, device = (*batch, guides, self.size), self.spec.device
        if not self.continuous:
            return Bounded(0, 1, shape, device=device, dtype=self.dtype)
        if self.bounds is None:
            return Unbounded(shape, device=device, dtype=self.dtype)
        low, high = (bound.expand(shape) for bound in self.bounds)
        return Bounded(low, high, shape, device=device, dtype=self.dtype)
