"""Conversion between the actions of an env and vectors of numbers."""

from __future__ import annotations

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec, Unbounded
from torchrl.envs import Transform


class ActionSpace:
    """Actions of an env as vectors [*batch, A]; a discrete action is one-hot, A is the number of choices.

    Args:
        spec: action spec of the env.
        batch_dims: number of batch dimensions of the env.
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

    @classmethod
    def of_parent(cls, transform: Transform, action_key: NestedKey) -> ActionSpace:
        """Return the action space of the env of a transform. Slow: `Transform.parent` rebuilds the env.

        Raises:
            RuntimeError: outside an env.
        """
        if transform.parent is None:
            raise RuntimeError(
                f"{type(transform).__name__} needs the action spec of an env: use it in a TransformedEnv"
            )
        return cls(transform.parent.full_action_spec[action_key], transform.parent.batch_dims)

    def vectors(self, action: Tensor) -> Tensor:
        """Convert env actions to vectors [*batch, A]."""
        if self.choices:
            batch = action.shape[: action.ndim - len(self.event)]
            action = F.one_hot(action.reshape(batch).long(), self.choices)
        return action if action.dtype.is_floating_point else action.to(self.dtype)

    def actions(self, vectors: Tensor) -> Tensor:
        """Convert vectors [*batch, A] to env actions; a discrete action is the argmax."""
        if self.continuous:
            return vectors
        best = vectors.argmax(-1)
        if isinstance(self.spec, OneHot):
            return F.one_hot(best, self.size).to(self.spec.dtype)
        return best.reshape((*best.shape, *self.event)).to(self.spec.dtype)

    def clamp(self, vectors: Tensor) -> Tensor:
        """Clamp vectors [*batch, A] to the bounds of the action, if it has any."""
        return vectors if self.bounds is None else vectors.clamp(*self.bounds)

    def advice_spec(self, batch: torch.Size, guides: int) -> TensorSpec:
        """Return the spec of advice [*batch, guides, A]: bounds of the action, 0 and 1 for one-hot vectors."""
        shape, device = (*batch, guides, self.size), self.spec.device
        if not self.continuous:
            return Bounded(0, 1, shape, device=device, dtype=self.dtype)
        if self.bounds is None:
            return Unbounded(shape, device=device, dtype=self.dtype)
        low, high = (bound.expand(shape) for bound in self.bounds)
        return Bounded(low, high, shape, device=device, dtype=self.dtype)
