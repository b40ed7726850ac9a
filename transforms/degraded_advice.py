"""Degraded advice: controls for the claim that a guide helps.

Each transform follows `GuideActions` and changes its entry in place, within the same bounds, so
several can be chained. Biased, scaled, partial, delayed and noisy advice degrade a guide. Random,
shuffled and removed advice are placebos.
"""

import math
import warnings
from collections.abc import Callable
from functools import cache
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import Transform

from coil_rl.transforms.action_space import ActionSpace, ChosenActionTransform, nested_key
from coil_rl.transforms.guide_transform import SeededGenerator
from coil_rl.transforms.normalised_action import ActionUnits, units_of

LONGEST_DELAY = 10_000  # steps, each of which is kept for every row


class DegradedAdvice(Transform):
    """Base class: applies `degrade` to the advice of all guides.

    Advice is degraded in normalised actions, see `ActionUnits`. The result is clamped to the bounds
    of the advice. `transform(tensordict)` does the same for stored data; outside an env there are
    no bounds, and advice counts as normalised.

    Args:
        key: entry of the advice, [*batch, n_guides, A].
        memory_key: entry for advice of the past, [*batch, slots, n_guides, A].
        slots: length of the memory; 0 for none.
    """

    needs_past = False  # whether stored data of a single step are not enough
    numbers_only: str | None = None  # its name in conf/degrade if it is not for choices

    def __init__(
        self, key: NestedKey = "guide_action", memory_key: NestedKey | None = None, slots: int = 0
    ) -> None:
        key, memory_key = nested_key(key), nested_key(memory_key)
        out_keys = [key, memory_key] if slots else [key]
        super().__init__(in_keys=[key], out_keys=out_keys)
        self.key, self.memory_key, self.slots = key, memory_key, slots
        self._bounds: tuple[Tensor, Tensor] | None = None
        self._units: ActionUnits | None = None
        self._choices: ActionSpace | None = None  # the space of the action if it is choices
        self._bounds_known = False

    def degrade(self, advice: Tensor) -> Tensor:
        """Return the degraded advice, [*batch, n_guides, A]."""
        raise NotImplementedError(f"{type(self).__name__} must define degrade")

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._write(next_tensordict, self.degrade(self._normalised(next_tensordict)))

    def _normalised(self, tensordict: TensorDictBase) -> Tensor:
        """Return the advice in normalised numbers."""
        self._know_bounds()
        advice = tensordict[self.key]
        return advice if self._units is None else self._units.normalise(advice)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Degrade the advice in stored data.

        Raises:
            RuntimeError: if the advice depends on previous steps, which stored data lacks.
        """
        if self.needs_past:
            raise RuntimeError(
                f"{type(self).__name__} needs the previous steps: use it in a TransformedEnv"
            )
        return DegradedAdvice._call(self, tensordict)

    def _know_bounds(self) -> None:
        """Find the bounds and the unit of the advice, once: `self.parent` is as slow as a step."""
        if self._bounds_known or self.parent is None:
            return
        spec = self.parent.full_observation_spec[self.key]
        if isinstance(spec, Bounded):
            first = (0,) * len(self.parent.batch_size)
            self._bounds = spec.space.low[first], spec.space.high[first]
        keys, batch_dims = self.parent.action_keys, len(self.parent.batch_size)
        space = ActionSpace(self.parent.full_action_spec[keys[0]], batch_dims)
        if space.choices:
            self._choices = space
            if self.numbers_only is not None:
                say_for_numbers(self.numbers_only, type(self).__name__)
        else:
            self._units = units_of(spec, batch_dims)
        self._bounds_known = True

    def _write(self, tensordict: TensorDictBase, advice: Tensor) -> TensorDictBase:
        """Write normalised advice in its own unit and within its bounds."""
        self._know_bounds()
        if self._units is not None:
            advice = self._units.denormalise(advice)
        if self._bounds is not None:
            advice = advice.clamp(*self._bounds)
        return tensordict.set(self.key, advice)

    def _memory_spec(self, advice: TensorSpec) -> dict[NestedKey, TensorSpec]:
        *batch, guides, size = advice.shape
        memory = advice.unsqueeze(-3).expand(*batch, self.slots, guides, size)
        return {self.memory_key: memory.clone()} if self.slots else {}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the memory; raises a `KeyError` without advice."""
        if self.key not in observation_spec.keys(True, True):
            raise KeyError(
                f"{type(self).__name__} changes {self.key!r}, but the env writes "
                f"{sorted(map(str, observation_spec))}; put it behind GuideActions"
            )
        return observation_spec.update(self._memory_spec(observation_spec[self.key]))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the memory, which is an input of resets."""
        if self.slots:
            state = input_spec["full_state_spec"] or Composite(
                shape=input_spec.shape, device=input_spec.device
            )
            memory = self._memory_spec(self.parent.full_observation_spec[self.key])
            input_spec["full_state_spec"] = state.update(memory)
        return input_spec


class BiasedAdvice(DegradedAdvice):
    """Advice with a constant offset.

    It is for actions that are numbers: the advice of choices stays the same, with a warning.

    Args:
        offset: in normalised actions, finite.
        key: entry of the advice, [*batch, n_guides, A].
    """

    numbers_only = "biased"

    def __init__(self, offset: float = 0.2, key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        self.offset = _finite("offset", offset)

    def degrade(self, advice: Tensor) -> Tensor:
        """Return advice + offset."""
        return advice + self.offset


class ScaledAdvice(DegradedAdvice):
    """Advice multiplied by a constant: 0 is the centre of a bounded action.

    Args:
        gain: the constant, finite: 0.5 for an undertuned guide, 0 for neutral advice, -1 for an
            adversary. With a negative one choices are advised in the reverse order; a positive one
            leaves them as they are, with a warning.
        key: entry of the advice, [*batch, n_guides, A].
    """

    def __init__(self, gain: float, key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        self.gain = _finite("gain", gain)
        self.numbers_only = "undertuned" if gain > 0 else None

    def degrade(self, advice: Tensor) -> Tensor:
        """Return advice * gain."""
        if self.gain < 0 and self._choices is not None:
            return self._choices.mirrored(advice) * -self.gain
        return advice * self.gain


class PartialAdvice(DegradedAdvice):
    """Advice to one side only, 0 (the centre of a bounded action) for the other side.

    Choices have no sides: they stay as they are, or become zeros, with a warning.

    Args:
        side: "left" keeps positive values, "right" negative values; else a `ValueError`.
        key: entry of the advice, [*batch, n_guides, A].
    """

    numbers_only = "partial"

    def __init__(self, side: Literal["left", "right"], key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        if side not in ("left", "right"):
            raise ValueError(f"side={side!r} must be one of left, right")
        self.side = side

    def degrade(self, advice: Tensor) -> Tensor:
        """Return the positive or the negative part of the advice."""
        return advice.clamp(min=0) if self.side == "left" else advice.clamp(max=0)


class _DrawnAdvice(DegradedAdvice):
    """Base class of advice changed by random numbers, drawn anew at every step.

    Args:
        seed: of the draws.
        key: entry of the advice, [*batch, n_guides, A].
    """

    def __init__(self, seed: int, key: NestedKey) -> None:
        super().__init__(key)
        self.rng = SeededGenerator(seed)

    def _draw(self, sample: Callable[..., Tensor], advice: Tensor, after_reset: bool) -> Tensor:
        """Draw one random number for each number of the advice, see `SeededGenerator.draw`."""
        (draws,) = self.rng.draw(sample, [advice.shape], after_reset=after_reset)
        return draws.to(advice)

    def degrade(self, advice: Tensor, after_reset: bool = False) -> Tensor:
        """Return the degraded advice, [*batch, n_guides, A], in a step or after a partial reset."""
        raise NotImplementedError

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        after_reset = tensordict.get("_reset", None) is not None
        advice = self._normalised(tensordict_reset)
        return self._write(tensordict_reset, self.degrade(advice, after_reset))


class NoisyAdvice(_DrawnAdvice):
    """Advice with Gaussian noise, independent at every step.

    Args:
        sigma: standard deviation in normalised actions, finite and at least 0.
        seed: of the draws.
        key: entry of the advice, [*batch, n_guides, A].
    """

    def __init__(self, sigma: float = 0.3, seed: int = 0, key: NestedKey = "guide_action") -> None:
        super().__init__(seed, key)
        if not 0 <= sigma < math.inf:
            raise ValueError(f"sigma={sigma} must be a finite number of at least 0")
        self.sigma = sigma

    def degrade(self, advice: Tensor, after_reset: bool = False) -> Tensor:
        """Return advice + noise."""
        return torch.add(advice, self._draw(torch.randn, advice, after_reset), alpha=self.sigma)


class RandomAdvice(_DrawnAdvice):
    """Placebo: uniform random numbers, or a random choice, instead of advice, drawn at every step.

    Args:
        low: smallest number, in normalised actions, finite.
        high: largest number, in normalised actions, finite and more than `low`.
        seed: of the draws.
        key: entry of the advice, [*batch, n_guides, A].
    """

    def __init__(
        self, low: float = -1.0, high: float = 1.0, seed: int = 0, key: NestedKey = "guide_action"
    ) -> None:
        super().__init__(seed, key)
        if not -math.inf < low < high < math.inf:
            raise ValueError(f"low={low} must be less than high={high}, and both finite")
        self.low, self.range = low, high - low

    def degrade(self, advice: Tensor, after_reset: bool = False) -> Tensor:
        """Return random numbers."""
        draws = self._draw(torch.rand, advice, after_reset)
        if self._choices is not None:
            return self._choices.random(draws).to(advice)
        return self.low + self.range * draws


class ShuffledAdvice(DegradedAdvice):
    """Placebo: the advice for another row of the batch; same distribution, no information.

    At every step all rows are shifted by the same random number; where several rows have one case,
    those of each policy among themselves. In a partial reset, a new episode gets the previous
    advice of another row. When the env builds its specs, a batch of one row is a `ValueError`.

    Args:
        seed: of the draws.
        key: entry of the advice, [*batch, n_guides, A].
        memory_key: entry for the original advice, [*batch, 1, n_guides, A].
    """

    def __init__(
        self,
        seed: int = 0,
        key: NestedKey = "guide_action",
        memory_key: NestedKey = "unshuffled_advice",
    ) -> None:
        super().__init__(key, memory_key, slots=1)
        self.rng = SeededGenerator(seed)

    def degrade(self, advice: Tensor) -> Tensor:
        """Return the advice for other rows."""
        rows = advice.flatten(0, -3) if advice.ndim > 2 else advice.unsqueeze(0)
        self._check_rows(len(rows))
        among = self.rng.different or len(rows)
        if among == 1:  # rows of a single case
            among = len(rows)
        shift = int(torch.randint(1, among, (), generator=self.rng.generator))
        return rows.unflatten(0, (-1, among)).roll(shift, 1).view_as(advice)

    def _check_rows(self, rows: int) -> None:
        if rows < 2:
            raise ValueError(
                "ShuffledAdvice gives a row the advice of another row, but the batch is one row; "
                "use more"
            )

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict.set(self.memory_key, next_tensordict[self.key].unsqueeze(-3))
        return super()._call(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask, previous = tensordict.get("_reset", None), tensordict.get(self.memory_key, None)
        if mask is None or previous is None or mask.all():
            return self._call(tensordict_reset)
        tensordict_reset.set(self.memory_key, tensordict_reset[self.key].unsqueeze(-3))
        shuffled = self.degrade(previous.squeeze(-3))
        return tensordict_reset.set(self.key, shuffled)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the memory."""
        self._check_rows(self.parent.batch_size.numel())
        return super().transform_observation_spec(observation_spec)


class DelayedAdvice(DegradedAdvice):
    """Advice of an earlier step; at first the first advice of the episode.

    Args:
        steps: the delay, 0 for none, at most 10,000; else a `ValueError`.
        key: entry of the advice, [*batch, n_guides, A].
        memory_key: entry for the advice of the last steps, [*batch, steps, n_guides, A], oldest
            first.
    """

    needs_past = True

    def __init__(
        self,
        steps: int = 12,
        key: NestedKey = "guide_action",
        memory_key: NestedKey = "delayed_advice",
    ) -> None:
        if not 0 <= steps <= LONGEST_DELAY:
            raise ValueError(f"steps={steps} must be at least 0 and at most {LONGEST_DELAY}")
        super().__init__(key, memory_key, steps)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.slots:
            first = tensordict_reset[self.key].unsqueeze(-3)
            tensordict_reset.set(self.memory_key, first.repeat_interleave(self.slots, -3))
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if not self.slots:
            return next_tensordict
        memory, newest = tensordict[self.memory_key], next_tensordict[self.key].unsqueeze(-3)
        next_tensordict.set(self.memory_key, torch.cat([memory[..., 1:, :, :], newest], -3))
        return next_tensordict.set(self.key, memory[..., 0, :, :])


class RemovedAdvice(DegradedAdvice, ChosenActionTransform):
    """Placebo: the agent's previous action in place of the advice; zeros in the first step.

    It is the action that the agent chose, also where actions take effect later.

    Args:
        key: entry of the advice, [*batch, n_guides, A].
        action_key: entry of the action; a discrete action becomes one-hot.
    """

    chosen_key = "action_for_advice"
    needs_past = True

    def __init__(self, key: NestedKey = "guide_action", action_key: NestedKey = "action") -> None:
        super().__init__(key)
        self.action_key = nested_key(action_key)

    def degrade(self, advice: Tensor) -> Tensor:
        """Return zeros, for the first step."""
        return torch.zeros_like(advice)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        action = self.action_space.normalise(self.chosen_vectors(tensordict))
        advice = next_tensordict[self.key]
        return self._write(next_tensordict, action.to(advice.dtype).unsqueeze(-2).expand_as(advice))


@cache
def say_for_numbers(name: str, kind: str) -> None:
    """Warn once in a process that a degradation of numbers has no meaning for choices.

    Args:
        name: in conf/degrade.
        kind: name of its class.
    """
    warnings.warn(
        f"degrade={name} ({kind}) degrades numbers, but the action of this env is choices: the "
        "advice is the guide's choice all the same, or none at all; take degrade=adversarial, "
        "delayed, noisy, random, shuffled, removed or zeroed",
        stacklevel=2,
    )


def _finite(name: str, value: float) -> float:
    """Return a value; raise a `ValueError` if it is not finite."""
    if not math.isfinite(value):
        raise ValueError(f"{name}={value} must be a finite number")
    return value
