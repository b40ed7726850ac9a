"""Advice with chance in it: a noisy guide, and one that says anything."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from coil_rl.transforms.degraded_advice import DegradedAdvice


class DrawnAdvice(DegradedAdvice):
    """Changes advice at random, by draws from a generator of its own that `state_dict()` holds.

    Args:
        args: of `DegradedAdvice`, or of whatever comes between.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.generator = torch.Generator()

    def get_extra_state(self) -> Tensor:
        """The generator's state."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator."""
        self.generator.set_state(state.cpu())


class _Redrawn(DrawnAdvice):
    """Draws for every number of the advice at every step; a row's draws do not depend on when other rows begin."""

    def __init__(self, seed: int, key: NestedKey) -> None:
        super().__init__(key)
        self.generator.manual_seed(seed)

    def degrade(self, advice: Tensor) -> Tensor:
        """Advice and draw put together."""
        return self._with(advice, self._draw(advice)[0])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if tensordict.get("_reset", None) is None:
            return self._call(tensordict_reset)
        # The second half of what the next step is going to draw anyway: resets then change nothing that comes later.
        state, advice = self.generator.get_state(), tensordict_reset[self.key]
        draw = self._draw(advice)[1]
        self.generator.set_state(state)
        return self._write(tensordict_reset, self._with(advice, draw))

    def _draw(self, advice: Tensor) -> Tensor:
        """Two draws for every number of the advice."""
        raise NotImplementedError

    def _with(self, advice: Tensor, draw: Tensor) -> Tensor:
        raise NotImplementedError


class NoisyAdvice(_Redrawn):
    """Advice with Gaussian noise, new at every step.

    Args:
        sigma: standard deviation, in action units.
        seed: of the noise.
        key: the advice, [*batch, n_guides, A].

    Raises:
        ValueError: for a sigma that is negative or not finite.
    """

    def __init__(self, sigma: float = 0.3, seed: int = 0, key: NestedKey = "guide_action") -> None:
        super().__init__(seed, key)
        if not 0 <= sigma < math.inf:
            raise ValueError(f"sigma={sigma} must be a finite number of at least 0")
        self.sigma = sigma

    def _draw(self, advice: Tensor) -> Tensor:
        return torch.randn(2, *advice.shape, generator=self.generator)

    def _with(self, advice: Tensor, draw: Tensor) -> Tensor:
        return torch.add(advice, draw.to(advice), alpha=self.sigma)


class RandomAdvice(_Redrawn):
    """Anything between two numbers, new at every step, whatever the guide says: a placebo.

    Args:
        low: of each number, in action units.
        high: of each number.
        seed: of the draws.
        key: the advice, [*batch, n_guides, A].

    Raises:
        ValueError: if low is not less than high.
    """

    def __init__(self, low: float = -1.0, high: float = 1.0, seed: int = 0, key: NestedKey = "guide_action") -> None:
        super().__init__(seed, key)
        if not -math.inf < low < high < math.inf:
            raise ValueError(f"low={low} must be less than high={high}, and both finite")
        self.low_draw, self.range = low, high - low

    def _draw(self, advice: Tensor) -> Tensor:
        return torch.rand(2, *advice.shape, generator=self.generator)

    def _with(self, advice: Tensor, draw: Tensor) -> Tensor:
        return self.low_draw + self.range * draw.to(advice)
