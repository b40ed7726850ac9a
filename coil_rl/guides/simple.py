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

from coil_rl.errors import UserError
from coil_rl.ranges import Count, checked
from coil_rl.transforms.action_space import ActionSpace, OwnForms, nested_key
from coil_rl.transforms.guide_transform import SeededGenerator
from coil_rl.transforms.hosted import ToldGuide


def _batch_of(tensordict: TensorDictBase, key: NestedKey) -> torch.Size:
    """Return the batch shape of the TensorDict that holds an entry."""
    if isinstance(key, str) or len(key) == 1:
        return tensordict.batch_size
    return tensordict[key[:-1]].batch_size


class ConstantGuide(TensorDictModuleBase):
    """Guide with a constant action.

    Args:
        value: the action in the unit of the env, one number or one per dimension.
        in_key: any entry, for the batch shape.
        out_key: entry for the action, [*batch, A].
    """

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
        batch = _batch_of(tensordict, self.in_keys[0])
        return tensordict.set(self.out_keys[0], self.value.expand(*batch, *self.value.shape))


@checked
class ZeroGuide(ConstantGuide, ToldGuide):
    """Guide with the neutral action: the centre of a bounded coordinate, the first of some choices.

    Args:
        size: A, number of dimensions of the action where no env says it, at least 1.
        in_key: any entry, for the batch shape.
        out_key: entry for the action, [*batch, A]; 0 until `GuideActions` says which actions there
            are.
    """

    def __init__(
        self, size: Count = 1, in_key: NestedKey = "observation", out_key: NestedKey = "action"
    ) -> None:
        super().__init__(0.0, in_key, out_key)
        self.value: Tensor = nn.Buffer(torch.zeros(size), persistent=False)

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Take the neutral action of the env."""
        self.value = space.neutral()


@checked
class RandomGuide(ToldGuide):
    """Guide with random actions, uniform in the actions of the env: numbers or choices.

    Of a coordinate without a bound see `ActionSpace.random`. The state of its generator is in
    `state_dict()`.

    Args:
        low: smallest number, in the unit of the env; None: that of the env, or -1 outside of one.
        high: largest number, in the unit of the env; None: that of the env, or 1 outside of one.
        size: A, number of dimensions of the action with `low` or `high` or outside of an env, at
            least 1.
        seed: of the generator.
        in_key: any entry, for the batch shape.
        out_key: entry for the action, [*batch, A].
    """

    def __init__(
        self,
        low: float | None = None,
        high: float | None = None,
        size: Count = 1,
        seed: int = 0,
        in_key: NestedKey = "observation",
        out_key: NestedKey = "action",
    ) -> None:
        self.in_keys, self.out_keys = [in_key], [out_key]
        super().__init__()
        self.low, self.high, self.size = low, high, size
        self.module = SeededGenerator(seed)
        self.space: ActionSpace | None = None

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Draw from the actions of the env from here on, unless `low` or `high` is given."""
        if self.low is None and self.high is None:
            self.space = space

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        batch, space = _batch_of(tensordict, self.in_keys[0]), self.space
        size = (self.size,) if space is None else (*space.agents, space.size)
        draws = self.module.sample(torch.rand, (*batch, *size))
        if space is not None:
            action = space.random(draws.to(tensordict.device, space.dtype))
        else:
            low = -1.0 if self.low is None else self.low
            high = 1.0 if self.high is None else self.high
            action = (low + (high - low) * draws).to(tensordict.device)
        return tensordict.set(self.out_keys[0], action)


class EntryGuide(TensorDictModule):
    """The action in an entry of the env, as of a controller inside of it.

    Such a controller may know more than agents observe.

    Args:
        key: the entry, [*batch, A].
    """

    sees = "env"

    def __init__(self, key: NestedKey | Sequence[str]) -> None:
        super().__init__(nn.Identity(), in_keys=[nested_key(key)], out_keys=["action"])


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
        known, acts = env.observation_spec[in_key].shape[-2], int(self.guide.max())
        if acts >= known:
            raise UserError(
                f"guide: the configuration has {acts + 1} guides, but its method.transforms give "
                f"the advice of {known}; they must be the same"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        advice = tensordict[self.in_keys[0]]
        lead = advice.shape[:-2]
        # One for each row, whatever number of agents the row has.
        guide = self.guide[(..., *(None,) * (len(lead) - self.guide.ndim))].expand(lead)
        guide = guide[..., None, None].expand_as(advice[..., :1, :])
        chosen = advice.gather(-2, guide).squeeze(-2)
        return tensordict.set(self.out_keys[0], self.action_space.actions(chosen))
