"""Degraded advice: controls for the claim that a guide helps.

Each transform follows `GuideActions` and changes its entry in place, within the same bounds, so
several can be chained. Biased, scaled, partial, delayed and noisy advice degrade a guide. Random,
shuffled and removed advice are placebos.
"""

import math
import warnings
from abc import abstractmethod
from collections.abc import Mapping
from functools import cache, cached_property
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from coil_rl.ranges import Finite, NonNegative, checked
from coil_rl.transforms.action_space import ActionSpace, ActionTransform, nested_key
from coil_rl.transforms.disturbance import Lag
from coil_rl.transforms.guide_transform import DrawingLink, SeededGenerator
from coil_rl.transforms.link import Link, State

CHOSEN = "action_for_advice"  # entry for the action that the agent chose, within a step


class DegradedAdvice(Link):
    """Base class: applies `degrade` to the advice of all guides.

    Advice is degraded in normalised actions, see `ActionUnits`. The result is clamped to the bounds
    of the advice. `transform(tensordict)` does the same for stored data; outside an env there are
    no bounds, and advice counts as normalised.

    Args:
        key: entry of the advice, [*batch, n_guides, A].
        memory_key: entry for advice of the past, [*batch, slots, n_guides, A]; None: no memory.
        slots: length of the memory.
    """

    numbers_only: str | None = None  # its name in conf/degrade if it is not for choices

    def __init__(
        self, key: NestedKey = "guide_action", memory_key: NestedKey | None = None, slots: int = 0
    ) -> None:
        key, memory_key = nested_key(key), nested_key(memory_key)
        out_keys = [key] if memory_key is None else [key, memory_key]
        super().__init__(in_keys=[key], out_keys=out_keys)
        self.key, self.memory_key, self.slots = key, memory_key, slots

    def degrade(self, advice: Tensor) -> Tensor:
        """Return the degraded advice, [*batch, n_guides, A]."""
        raise NotImplementedError(f"{type(self).__name__} must define degrade")

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the degraded advice."""
        self._write(data, self.degrade(self._normalised(data)))
        return state

    @cached_property
    def space(self) -> ActionSpace | None:
        """Space of the env's action; None outside an env."""
        env = self.parent  # as slow as a step
        if env is None:
            return None
        space = ActionSpace(env.full_action_spec[env.action_keys[0]], len(env.batch_size))
        if space.choices and self.numbers_only is not None:
            say_for_numbers(self.numbers_only, type(self).__name__)
        return space

    def _normalised(self, tensordict: TensorDictBase) -> Tensor:
        """Return the advice in normalised numbers."""
        advice = tensordict[self.key]
        if self.space is None:
            return advice
        return self.space.normalise(advice.movedim(-2, 0)).movedim(0, -2)

    def _write(self, tensordict: TensorDictBase, advice: Tensor) -> TensorDictBase:
        """Write normalised advice in its own unit and within its bounds."""
        if self.space is not None and self.space.choices:
            advice = advice.clamp(0, 1)
        elif self.space is not None:
            advice = self.space.denormalise(advice.movedim(-2, 0)).movedim(0, -2)
        return tensordict.set(self.key, advice)

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """The advice of the past, if it has a memory."""
        if self.memory_key is None:
            return {}
        advice = self.parent.full_observation_spec[self.key]
        *batch, guides, size = advice.shape
        memory = advice.unsqueeze(-3).expand(*batch, self.slots, guides, size)
        return {self.memory_key: memory.clone()}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the memory; raises a `KeyError` without advice."""
        if self.key not in observation_spec.keys(True, True):
            raise KeyError(
                f"{type(self).__name__} changes {self.key!r}, but the env writes "
                f"{sorted(map(str, observation_spec))}; put it behind GuideActions"
            )
        return super().transform_observation_spec(observation_spec)


@checked
class BiasedAdvice(DegradedAdvice):
    """Advice with a constant offset.

    It is for actions that are numbers: the advice of choices stays the same, with a warning.

    Args:
        offset: in normalised actions.
    """

    numbers_only = "biased"

    def __init__(self, offset: Finite = 0.2, key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        self.offset = offset

    def degrade(self, advice: Tensor) -> Tensor:
        """Return advice + offset."""
        return advice + self.offset


@checked
class ScaledAdvice(DegradedAdvice):
    """Advice multiplied by a constant: 0 is the centre of a bounded action.

    Args:
        gain: the constant: 0.5 for an undertuned guide, 0 for neutral advice, -1 for an
            adversary. With a negative one choices are advised in the reverse order; a positive one
            leaves them as they are, with a warning.
    """

    def __init__(self, gain: Finite, key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        self.gain = gain
        self.numbers_only = "undertuned" if gain > 0 else None

    def degrade(self, advice: Tensor) -> Tensor:
        """Return advice * gain."""
        if self.gain < 0 and self.space is not None and self.space.choices:
            return self.space.mirrored(advice) * -self.gain
        return advice * self.gain


@checked
class PartialAdvice(DegradedAdvice):
    """Advice to one side only, 0 (the centre of a bounded action) for the other side.

    Choices have no sides: they stay as they are, or become zeros, with a warning.

    Args:
        side: "left" keeps positive values, "right" negative values.
    """

    numbers_only = "partial"

    def __init__(self, side: Literal["left", "right"], key: NestedKey = "guide_action") -> None:
        super().__init__(key)
        self.side = side

    def degrade(self, advice: Tensor) -> Tensor:
        """Return the positive or the negative part of the advice."""
        return advice.clamp(min=0) if self.side == "left" else advice.clamp(max=0)


class _DrawnAdvice(DrawingLink, DegradedAdvice):
    """Base class of advice changed by random numbers, drawn anew at every step.

    Args:
        seed: of the draws.
    """

    def __init__(self, seed: int, key: NestedKey) -> None:
        super().__init__(key)
        self.rng = SeededGenerator(seed)

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the degraded advice; the state is what was drawn for it."""
        advice = self._normalised(data)
        self._write(data, self.changed(advice, state[self.key].to(advice)))
        return {}

    @abstractmethod
    def changed(self, advice: Tensor, draws: Tensor) -> Tensor:
        """Return the degraded advice, [*batch, n_guides, A], by the numbers that were drawn."""


@checked
class NoisyAdvice(_DrawnAdvice):
    """Advice with Gaussian noise, independent at every step.

    Args:
        sigma: standard deviation in normalised actions.
    """

    def __init__(
        self, sigma: NonNegative = 0.3, seed: int = 0, key: NestedKey = "guide_action"
    ) -> None:
        super().__init__(seed, key)
        self.sigma = sigma

    def changed(self, advice: Tensor, draws: Tensor) -> Tensor:
        """Return advice + noise."""
        return torch.add(advice, draws, alpha=self.sigma)


class RandomAdvice(_DrawnAdvice):
    """Placebo: uniform random numbers, or a random choice, instead of advice, drawn at every step.

    Args:
        low: smallest number, in normalised actions, finite.
        high: largest number, in normalised actions, finite and more than `low`.
    """

    _sample = staticmethod(torch.rand)

    def __init__(
        self, low: float = -1.0, high: float = 1.0, seed: int = 0, key: NestedKey = "guide_action"
    ) -> None:
        super().__init__(seed, key)
        if not -math.inf < low < high < math.inf:
            raise ValueError(f"low={low} must be less than high={high}, and both finite")
        self.low, self.range = low, high - low

    def changed(self, advice: Tensor, draws: Tensor) -> Tensor:
        """Return random numbers."""
        if self.space is not None and self.space.choices:
            return self.space.random(draws).to(advice)
        return self.low + self.range * draws


class ShuffledAdvice(DegradedAdvice):
    """Placebo: the advice for another row of the batch; same distribution, no information.

    At every step all rows are shifted by the same random number; where several rows have one case,
    those of each policy among themselves. In a partial reset, a new episode gets the previous
    advice of another row. When the env builds its specs, a batch of one row is a `ValueError`.

    Args:
        seed: of the draws.
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

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return the advice of all rows in the step before, in a partial reset."""
        mask = None if reset is None else reset.get("_reset", None)
        if reset is None or mask is None or mask.all() or self.memory_key not in reset.keys(True):
            return {}
        return {"previous": reset[self.memory_key].squeeze(-3)}

    def sent(self, data: TensorDictBase, state: State) -> State:
        """Forget the advice: what is shuffled is that of the step."""
        return {}

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the advice for other rows, and return the original one."""
        advice = data[self.key]
        if "previous" in state:
            data.set(self.key, self.degrade(state["previous"]))
        else:
            self._write(data, self.degrade(self._normalised(data)))
        return {self.memory_key: advice.unsqueeze(-3)}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the memory."""
        self._check_rows(self.parent.batch_size.numel())
        return super().transform_observation_spec(observation_spec)


@checked
class DelayedAdvice(DegradedAdvice):
    """Advice of an earlier step; at first the first advice of the episode.

    Args:
        steps: the delay, 0 for none.
        memory_key: entry for the advice of the last steps, [*batch, steps, n_guides, A], oldest
            first.
    """

    needs_past = True

    def __init__(
        self,
        steps: Lag = 12,
        key: NestedKey = "guide_action",
        memory_key: NestedKey = "delayed_advice",
    ) -> None:
        super().__init__(key, memory_key, steps)

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return that nothing was advised before, as NaN; the first advice takes its place."""
        missing = torch.full_like(self._entry(data, self.key), torch.nan).unsqueeze(-3)
        return {self.memory_key: missing.repeat_interleave(self.slots, -3)}

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the oldest advice, and keep the new one."""
        newest, memory = data[self.key].unsqueeze(-3), state[self.memory_key]
        values = torch.cat([torch.where(memory.isnan(), newest, memory), newest], -3)
        data.set(self.key, values[..., 0, :, :])
        return {self.memory_key: values[..., 1:, :, :]}


class RemovedAdvice(DegradedAdvice, ActionTransform):
    """Placebo: the agent's previous action in place of the advice; zeros in the first step.

    It is the action that the agent chose, also where actions take effect later.

    Args:
        action_key: entry of the action; a discrete action becomes one-hot.
    """

    passed = (CHOSEN,)
    needs_past = True

    def __init__(self, key: NestedKey = "guide_action", action_key: NestedKey = "action") -> None:
        super().__init__(key)
        self.action_key = nested_key(action_key)

    def act(self, data: TensorDictBase, state: State) -> State:
        """Keep the action that was chosen, in normalised numbers."""
        vectors = self.action_space.vectors(data[self.action_key])
        return {CHOSEN: self.action_space.normalise(vectors)}

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Return zeros."""
        space = self.action_space
        shape = (*data.batch_size, *space.agents, space.size)
        return {CHOSEN: torch.zeros(shape, dtype=space.dtype, device=data.device)}

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the action of the step before as advice."""
        advice = data[self.key]
        self._write(data, state[CHOSEN].to(advice.dtype).unsqueeze(-2).expand_as(advice))
        return {}


@cache
def say_for_numbers(name: str, kind: str) -> None:
    """Warn once in a process that a degradation of numbers has no meaning for choices."""
    warnings.warn(
        f"degrade={name} ({kind}) degrades numbers, but the action of this env is choices: the "
        "advice is the guide's choice all the same, or none at all; take degrade=adversarial, "
        "delayed, noisy, random, shuffled, removed or zeroed",
        stacklevel=2,
    )
