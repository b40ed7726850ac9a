"""Base class of transforms that use a guide's advice, and a random generator with a saved state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import Transform

from coil_rl.transforms.action_space import ActionSpace

Schedule = Callable[[float], float]


class GuideTransform(Transform):
    """Base class of transforms that use the advice observed by the agent; place them after `GuideActions`.

    TorchRL keeps transforms in evaluation mode until `env.train()` is called. In evaluation a schedule returns its
    final value, and changes that serve learning only are off.

    Args:
        out_keys: entries written.
        guide: row of the advice `guide_action`, [*batch, n_guides, A].

    Attributes:
        progress: completed fraction of the run, for schedules; set by the training loop.
        mdp_parameter: name of the parameter that changes rewards or transitions, empty if there is none. If that
            parameter is a schedule, stored transitions become invalid during the run.
    """

    mdp_parameter: str = ""
    action_key: NestedKey = "action"
    advice_key: NestedKey = "guide_action"

    def __init__(self, out_keys: Sequence[NestedKey] = (), *, guide: int = 0) -> None:
        if guide < 0:
            raise ValueError(f"guide={guide} must be at least 0: it is a row of the advice")
        super().__init__(in_keys=[], out_keys=list(out_keys))
        self.guide, self.progress = guide, 0.0

    def current(self, value: float | Schedule) -> float:
        """Return the current value of a number or a schedule."""
        if not callable(value):
            return value
        return value(self.progress if self.training else 1.0)

    def advice(self, tensordict: TensorDictBase) -> Tensor:
        """Return the advice of the guide, [*batch, A]."""
        advice: Tensor = tensordict[self.advice_key]
        return advice[..., self.guide, :]

    @cached_property
    def action_space(self) -> ActionSpace:
        """Action space of the env; RuntimeError outside an env."""
        return ActionSpace.of_parent(self, self.action_key)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Check that the env writes the advice.

        Raises:
            KeyError: without this row of advice.
        """
        spec = observation_spec.get(self.advice_key, None)
        if spec is None or self.guide >= spec.shape[-2]:
            found = "no advice" if spec is None else f"advice of {spec.shape[-2]} guides"
            raise KeyError(
                f"{type(self).__name__} reads row {self.guide} of {self.advice_key}, but there is {found}; "
                "put GuideActions with enough guides before it"
            )
        return observation_spec

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return stored data unchanged."""
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict


class SeededGenerator(nn.Module):
    """Random generator on the CPU with its state in `state_dict()`."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.generator = torch.Generator().manual_seed(seed)

    def get_extra_state(self) -> Tensor:
        """Return the state of the generator."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator."""
        self.generator.set_state(state.cpu())
