"""Constant and random guides as baselines, and a policy that follows the advice.

A guide without information shows what an agent gains by the mere presence of another entry. The
policy shows what a guide reaches alone, behind all transforms that change its advice.
"""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.envs.limits import check_range
from coil_rl.transforms.action_space import ActionSpace
from coil_rl.transforms.guide_transform import SeededGenerator


class _Uniform(SeededGenerator):
    """Uniform random numbers [*batch, size] from `low` to `high`, whatever is observed."""

    def __init__(self, low: float, high: float, size: int, seed: int) -> None:
        super().__init__(seed)
        self.low, self.high, self.size = low, high, size

    def forward(self, observation: Tensor) -> Tensor:
        draw = torch.rand(*observation.shape[:-1], self.size, generator=self.generator)
        return (self.low + (self.high - self.low) * draw).to(observation)


class ConstantGuide(TensorDictModuleBase):
    """Guide with a constant action.

    Args:
        value: the action in action units, one number or one per dimension.
        in_key: any entry [*batch, N], for the batch shape.
        out_key: entry for the action, [*batch, A].
    """

    pure = True

    def __init__(
        self,
        value: float | Sequence[float],
        in_key: NestedKey = "observation",
        out_key: NestedKey = "action",
    ) -> None:
        self.in_keys, self.out_keys = [in_key], [out_key]
        super().__init__()
        self.value: Tensor = nn.Buffer(torch.atleast_1d(torch.as_tensor(value)))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        batch = tensordict[self.in_keys[0]].shape[:-1]
        return tensordict.set(self.out_keys[0], self.value.expand(*batch, -1))


class ZeroGuide(ConstantGuide):
    """Guide with the action 0.

    Args:
        size: A, number of dimensions of the action, at least 1.
        in_key: any entry [*batch, N], for the batch shape.
        out_key: entry for the action, [*batch, A].
    """

    def __init__(
        self, size: int = 1, in_key: NestedKey = "observation", out_key: NestedKey = "action"
    ) -> None:
        check_range(1, size=size)
        super().__init__([0.0] * size, in_key, out_key)


class RandomGuide(TensorDictModule):
    """Guide with uniform random actions.

    The state of its generator is in `state_dict()`.

    Args:
        low: smallest number, in action units.
        high: largest number, in action units.
        size: A, number of dimensions of the action, at least 1.
        seed: of the generator.
        in_key: any entry [*batch, N], for the batch shape.
        out_key: entry for the action, [*batch, A].
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
        check_range(1, size=size)
        super().__init__(_Uniform(low, high, size, seed), in_keys=[in_key], out_keys=[out_key])


class FollowAdvice(TensorDictModuleBase):
    """Policy that takes the action advised by one guide, after all transforms of the advice.

    Args:
        env: env of the actions.
        guide: row of the advice, or one for each row of the env.
        in_key: entry of the advice, [*batch, n_guides, A].
        out_key: entry for the action.
    """

    def __init__(
        self,
        env: EnvBase,
        guide: int | Sequence[int] = 0,
        in_key: NestedKey = "guide_action",
        out_key: NestedKey = "action",
    ) -> None:
        self.in_keys, self.out_keys = [in_key], [out_key]
        super().__init__()
        self.action_space = ActionSpace(env.full_action_spec[out_key], env.batch_dims)
        self.guide: Tensor = nn.Buffer(torch.as_tensor(guide, device=env.device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        advice = tensordict[self.in_keys[0]]
        guide = self.guide.expand(advice.shape[:-2])[..., None, None].expand_as(advice[..., :1, :])
        chosen = advice.gather(-2, guide).squeeze(-2)
        return tensordict.set(self.out_keys[0], self.action_space.actions(chosen))
