"""Guides that know nothing: the zero line for every claim that a guide helped."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.transforms.action_space import ActionSpace


class _Constant(nn.Module):
    value: Tensor

    def __init__(self, value: Tensor) -> None:
        super().__init__()
        self.register_buffer("value", value)

    def forward(self, observation: Tensor) -> Tensor:
        return self.value.expand(*observation.shape[:-1], -1)


class _Random(nn.Module):
    def __init__(self, low: float, high: float, size: int, seed: int) -> None:
        super().__init__()
        self.low, self.high, self.size = low, high, size
        self.generator = torch.Generator().manual_seed(seed)

    def forward(self, observation: Tensor) -> Tensor:
        draw = torch.rand(*observation.shape[:-1], self.size, generator=self.generator)
        return (self.low + (self.high - self.low) * draw).to(observation)

    def get_extra_state(self) -> Tensor:
        """The generator's state."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator."""
        self.generator.set_state(state.cpu())


class ConstantGuide(TensorDictModule):
    """Always the same action.

    Args:
        value: the action, one number or one per dimension.
        in_key: an entry [*batch, N] that tells the batch shape.
        out_key: where to write the action, [*batch, A].
    """

    pure = True

    def __init__(
        self, value: float | Sequence[float], in_key: NestedKey = "observation", out_key: NestedKey = "action"
    ) -> None:
        super().__init__(_Constant(torch.atleast_1d(torch.as_tensor(value))), in_keys=[in_key], out_keys=[out_key])


class ZeroGuide(ConstantGuide):
    """Always the action 0.

    Args:
        size: A, numbers in an action.
        in_key: an entry [*batch, N] that tells the batch shape.
        out_key: where to write the action, [*batch, A].
    """

    def __init__(self, size: int = 1, in_key: NestedKey = "observation", out_key: NestedKey = "action") -> None:
        _check_size(size)
        super().__init__([0.0] * size, in_key, out_key)


class RandomGuide(TensorDictModule):
    """A uniform action, drawn anew at every step from a generator of its own that `state_dict()` holds.

    Args:
        low: lower bound.
        high: upper bound.
        size: A, numbers in an action.
        seed: of the generator.
        in_key: an entry [*batch, N] that tells the batch shape.
        out_key: where to write the action, [*batch, A].
    """

    def __init__(
        self,
        low: float = -1.0,
        high: float = 1.0,
        size: int = 1,
        seed: int = 0,
        in_key: NestedKey = "observation",
        out_key: NestedKey = "action",
    ) -> None:
        _check_size(size)
        super().__init__(_Random(low, high, size, seed), in_keys=[in_key], out_keys=[out_key])


class FollowAdvice(TensorDictModuleBase):
    """Does what the advice says that `GuideActions` wrote: so a guide drives, whatever else happened to its advice.

    Args:
        env: for its actions.
        guide: which row of the advice, or which for each row of the env.
        in_key: of the advice, [*batch, n_guides, A].
        out_key: where to write the action.
    """

    guide: Tensor

    def __init__(
        self,
        env: EnvBase,
        guide: int | Sequence[int] = 0,
        in_key: NestedKey = "guide_action",
        out_key: NestedKey = "action",
    ) -> None:
        self.in_keys, self.out_keys = [in_key], [out_key]
        super().__init__()
        self.space = ActionSpace(env.full_action_spec[out_key], env.batch_dims)
        self.register_buffer("guide", torch.as_tensor(guide, device=env.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        advice = tensordict[self.in_keys[0]]
        guide = self.guide.expand(advice.shape[:-2])[..., None, None].expand_as(advice[..., :1, :])
        advice = advice.gather(-2, guide).squeeze(-2)
        return tensordict.set(self.out_keys[0], self.space.actions(advice))


def _check_size(size: int) -> None:
    if size < 1:
        raise ValueError(f"size={size} must be at least 1")
