"""Advice that comes from elsewhere: from another row, from the past, or from nobody.

The placebos among the degraded guides: what the agent gets moves like advice, and says less or nothing about now.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Composite, TensorSpec

from coil_rl.transforms.degraded_advice import DegradedAdvice
from coil_rl.transforms.drawn_advice import DrawnAdvice


class _Remembering(DegradedAdvice):
    """Keeps advice of the past in the tensordict, [*batch, slots, n_guides, A], and so with its row."""

    def __init__(self, slots: int, key: NestedKey, memory_key: NestedKey) -> None:
        super().__init__(key)
        self.slots, self.memory_key = slots, memory_key
        self.out_keys = [key, memory_key] if slots else [key]

    def _memory(self, advice: TensorSpec) -> dict[NestedKey, TensorSpec]:
        *batch, guides, size = advice.shape
        memory = advice.unsqueeze(-3).expand(*batch, self.slots, guides, size)
        return {self.memory_key: memory.clone()} if self.slots else {}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add what is remembered."""
        observation_spec = super().transform_observation_spec(observation_spec)
        return observation_spec.update(self._memory(observation_spec[self.key]))

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Ask for what is remembered, which a reset is not shown otherwise."""
        state = input_spec["full_state_spec"]
        if state is None:
            state = Composite(shape=input_spec.shape, device=input_spec.device)
        input_spec["full_state_spec"] = state.update(self._memory(self.parent.full_observation_spec[self.key]))
        return input_spec


class ShuffledAdvice(DrawnAdvice, _Remembering):
    """The advice that another row was given: as the guide's in distribution, without information.

    At every step all rows look the same random number of rows further. A row whose episode begins while others go on is
    given the advice that was meant for one of the others a step ago.

    Args:
        seed: of the draws.
        key: the advice, [*batch, n_guides, A].
        memory_key: where the advice goes as it was, [*batch, 1, n_guides, A].

    Raises:
        ValueError: if the batch is one row, in an env once it is asked for its specs.
    """

    def __init__(
        self, seed: int = 0, key: NestedKey = "guide_action", memory_key: NestedKey = "unshuffled_advice"
    ) -> None:
        super().__init__(1, key, memory_key)
        self.generator.manual_seed(seed)

    def degrade(self, advice: Tensor) -> Tensor:
        """The advice of other rows."""
        rows = advice.flatten(0, -3) if advice.ndim > 2 else advice.unsqueeze(0)
        self._check_rows(len(rows))
        return rows.roll(int(torch.randint(1, len(rows), (), generator=self.generator)), 0).view_as(advice)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict.set(self.memory_key, next_tensordict[self.key].unsqueeze(-3))
        return super()._call(next_tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Shuffle the rows of stored data."""
        return super()._call(tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add what is remembered, if there are rows to shuffle."""
        self._check_rows(self.parent.batch_size.numel())
        return super().transform_observation_spec(observation_spec)

    def _check_rows(self, rows: int) -> None:
        if rows < 2:
            raise ValueError("ShuffledAdvice gives a row the advice of another row, but the batch is one row; use more")

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask, before = tensordict.get("_reset", None), tensordict.get(self.memory_key, None)
        if mask is None or before is None or mask.all():
            return self._call(tensordict_reset)
        tensordict_reset.set(self.memory_key, tensordict_reset[self.key].unsqueeze(-3))
        return self._write(tensordict_reset, self.degrade(before.squeeze(-3)))


class DelayedAdvice(_Remembering):
    """The advice of some steps ago; until there is any, the first advice of the episode.

    Args:
        steps: k, how many steps ago; 0 changes nothing.
        key: the advice, [*batch, n_guides, A].
        memory_key: where the last k pieces of advice go, [*batch, k, n_guides, A], oldest first.

    Raises:
        ValueError: for a negative number of steps.
    """

    def __init__(
        self, steps: int = 12, key: NestedKey = "guide_action", memory_key: NestedKey = "delayed_advice"
    ) -> None:
        if steps < 0:
            raise ValueError(f"steps={steps} must be at least 0")
        super().__init__(steps, key, memory_key)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse: one moment does not tell what was advised before.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError("DelayedAdvice needs the steps before: it works inside a TransformedEnv only")

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
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


class RemovedAdvice(DegradedAdvice):
    """Nothing of the guide: in place of its advice the action that was taken last, 0 at the start of an episode.

    What is left if the agent gains from one more input that moves like an action. Where advice is one-hot, so is the
    last action, and no choice is marked at the start.

    Args:
        key: the advice, [*batch, n_guides, A].
        action_key: the action.
    """

    def __init__(self, key: NestedKey = "guide_action", action_key: NestedKey = "action") -> None:
        super().__init__(key)
        self.action_key = action_key

    def degrade(self, advice: Tensor) -> Tensor:
        """Zeros: no action was taken yet."""
        return torch.zeros_like(advice)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse: one moment does not tell which action led to it.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError("RemovedAdvice needs the step before: it works inside a TransformedEnv only")

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        advice = next_tensordict[self.key]
        action = tensordict[self.action_key].reshape(*next_tensordict.batch_size, -1)
        if action.shape[-1] != advice.shape[-1]:  # the number of a choice, of which advice is the one-hot form
            action = F.one_hot(action.squeeze(-1).long(), advice.shape[-1])
        return self._write(next_tensordict, action.to(advice.dtype).unsqueeze(-2).expand_as(advice))
