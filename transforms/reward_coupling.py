"""Reward coupling (RFC): a penalty on the distance between the actions of agent and guide.

It is equation 93 of the paper. The agent is not told the advice; it finds out by the reward that it
pays to act like the guide.
"""

from collections.abc import Mapping
from functools import cached_property
from typing import Literal, Unpack

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import TensorSpec, Unbounded

from coil_rl.ranges import checked
from coil_rl.transforms.guide_transform import GuideSettings, GuideTransform, Schedule
from coil_rl.transforms.link import Link

NORMS = {"l1": 1.0, "l2": 2.0, "linf": float("inf")}


@checked
class RewardCoupling(GuideTransform):
    """Reward R - beta ||a - g||, where g is the advice that the agent observed before action a.

    Both are normalised, see `ActionUnits`.

    Writes the env's own reward as `task_reward` [*batch, 1] and ||a - g|| as `guide_distance`
    [*batch, 1]. In evaluation the reward is the task reward.

    Args:
        beta: weight of the distance, a number or a schedule over the run.
        norm: of the distance, "l1", "l2" or "linf". Discrete actions are
            one-hot: l1 is 0 or 2, l2 is 0 or the root of 2.
        settings: further ones of `GuideTransform`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl import envs, guides, transforms
        >>> env = TransformedEnv(envs.ConeTrackEnv(envs.shipped_tracks("train"), num_envs=8))
        >>> env = env.append_transform(transforms.GuideActions({"middle": guides.SplineGuide()}))
        >>> env = env.append_transform(transforms.RewardCoupling(beta=0.1)).train()
        >>> after = env.rollout(3)["next"]
        >>> torch.equal(after["reward"], after["task_reward"] - 0.1 * after["guide_distance"])
        True
    """

    mdp_parameter = "beta"
    written = ("task_reward", "guide_distance")

    def __init__(
        self,
        beta: float | Schedule,
        norm: Literal["l1", "l2", "linf"] = "l2",
        **settings: Unpack[GuideSettings],
    ) -> None:
        super().__init__(**settings)
        self.beta, self.order = beta, NORMS[norm]

    @cached_property
    def reward_key(self) -> NestedKey:
        """Entry of the env's reward, which may be nested."""
        return self.parent.reward_key

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        reward = next_tensordict[self.reward_key]
        space = self.action_space
        # An env clamps what it is given.
        action = self.observed(space.vectors(tensordict[self.action_key]))
        difference = space.normalise(action) - space.normalise(self.advice(tensordict))
        distance = torch.linalg.vector_norm(difference, self.order, -1, keepdim=True)
        distance = distance.to(reward.dtype)
        if "task_reward" not in next_tensordict:  # of a `TaskReward` in front
            next_tensordict.set("task_reward", reward)
        next_tensordict.set("guide_distance", distance)
        if self.learns:
            next_tensordict.set(self.reward_key, reward - self.current(self.beta) * distance)
        return next_tensordict

    @property
    def records(self) -> Mapping[NestedKey, TensorSpec]:
        """`task_reward` and `guide_distance`."""
        reward = self.parent.full_reward_spec[self.reward_key]
        spec = Unbounded(reward.shape, device=reward.device, dtype=reward.dtype)
        return {key: spec.clone() for key in self.written}


class TaskReward(Link):
    """Keeps the reward as `task_reward`, in front of transforms that change it."""

    @property
    def records(self) -> Mapping[NestedKey, TensorSpec]:
        """`task_reward`."""
        return {"task_reward": self.parent.full_reward_spec[self.parent.reward_key].clone()}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("task_reward", next_tensordict[self.parent.reward_key])
