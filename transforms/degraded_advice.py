"""Advice that is made worse on purpose: guides that are biased, undertuned or right half of the time.

Whoever claims that a guide helped compares it with these. Each stands behind `GuideActions` and changes what it wrote,
under the same key and within the same bounds, so that nothing downstream knows; behind one another they add up.
"""

from __future__ import annotations

import math
from typing import Literal

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite
from torchrl.envs import Transform


class DegradedAdvice(Transform):
    """Changes the advice of every guide in the same way; what comes out of the advice's bounds is clipped to them.

    A subclass says how, in `degrade`. A call with stored data, `transform(tensordict)`, does the same; only a transform
    that belongs to an env knows bounds.

    Args:
        key: the advice, [*batch, n_guides, A] in action units.
    """

    low: Tensor | None
    high: Tensor | None

    def __init__(self, key: NestedKey = "guide_action") -> None:
        super().__init__(in_keys=[key], out_keys=[key])
        self.key = key
        # Asking the env costs as much as a step, so it is asked once.
        self._asked = False
        self.register_buffer("low", None, persistent=False)
        self.register_buffer("high", None, persistent=False)

    def degrade(self, advice: Tensor) -> Tensor:
        """The advice [*batch, n_guides, A] made worse."""
        raise NotImplementedError(f"{type(self).__name__} does not say how it changes the advice: define degrade")

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, self.degrade(next_tensordict[self.key]))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Degrade the advice in stored data, of any batch size."""
        return self._call(tensordict)

    def _write(self, tensordict: TensorDictBase, advice: Tensor) -> TensorDictBase:
        if not self._asked and self.parent is not None:
            self._asked, spec = True, self.parent.full_observation_spec[self.key]
            if isinstance(spec, Bounded):
                first = (0,) * len(self.parent.batch_size)
                self.low, self.high = spec.space.low[first], spec.space.high[first]
        return tensordict.set(self.key, advice if self.low is None else advice.clamp(self.low, self.high))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Leave it as it is.

        Raises:
            KeyError: without advice in it.
        """
        if self.key not in observation_spec.keys(True, True):
            raise KeyError(
                f"{type(self).__name__} changes {self.key!r}, but the env writes {sorted(map(str, observation_spec))}; "
                "put it behind GuideActions"
            )
        return observation_spec


class BiasedAdvice(DegradedAdvice):
    """Advice that is off by the same amount always.

    Args:
        offset: in action units.
        key: the advice, [*batch, n_guides, A].

    Raises:
        ValueError: for an offset that is not finite.
    """

    def __init__(self, offset: float = 0.2, key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        self.offset = _finite("offset", offset)

    def degrade(self, advice: Tensor) -> Tensor:
        """Advice + offset."""
        return advice + self.offset


class ScaledAdvice(DegradedAdvice):
    """A fraction of the advice.

    Args:
        gain: 0.5 is an undertuned guide, 0 a silent one, -1 an adversary.
        key: the advice, [*batch, n_guides, A].

    Raises:
        ValueError: for a gain that is not finite.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> stored = TensorDict({"guide_action": torch.tensor([[[0.5]], [[-1.0]]])}, [2])
        >>> ScaledAdvice(gain=-1)(stored)["guide_action"].flatten().tolist()
        [-0.5, 1.0]
    """

    def __init__(self, gain: float, key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        self.gain = _finite("gain", gain)

    def degrade(self, advice: Tensor) -> Tensor:
        """Advice * gain."""
        return advice * self.gain


class PartialAdvice(DegradedAdvice):
    """Advice that is right where it steers to one side, and 0 where it should steer to the other.

    Args:
        side: "left" keeps what is positive, "right" what is negative.
        key: the advice, [*batch, n_guides, A].

    Raises:
        ValueError: for another side.
    """

    def __init__(self, side: Literal["left", "right"], key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        if side not in ("left", "right"):
            raise ValueError(f"side={side!r} must be one of left, right")
        self.side = side

    def degrade(self, advice: Tensor) -> Tensor:
        """The positive or the negative part of the advice."""
        return advice.clamp(min=0) if self.side == "left" else advice.clamp(max=0)


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"{name}={value} must be a finite number")
    return value
