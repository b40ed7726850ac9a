"""Reward coupling (RFC): the agent pays for the distance between its action and the guide's (paper equation 93)."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from coil_rl.transforms.guided import Guided, Schedule

ORDERS = {"l1": 1.0, "l2": 2.0, "linf": float("inf")}


class RewardCoupling(Guided):
    """Makes the reward R - beta ||a - g||, where g is the advice the agent saw when it chose a.

    Beside it, `task_reward` [*batch, 1] is the env's own reward, and `guide_distance` [*batch, 1] is ||a - g||. In
    evaluation the reward is the task's.

    Args:
        beta: price of the distance, a number or a schedule over the run.
        norm: of the distance. Between choices, which are one-hot, l1 says 2 where they differ, l2 the root of it.
        guide: which row of the advice.

    Raises:
        ValueError: for a norm that is none.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl import envs, guides, transforms
        >>> env = TransformedEnv(envs.ConeTrackEnv(envs.shipped_tracks("train"), num_cars=8))
        >>> env = env.append_transform(transforms.GuideActions({"middle": guides.SplineGuide()}))
        >>> env = env.append_transform(transforms.RewardCoupling(beta=0.1)).train()
        >>> after = env.rollout(3)["next"]
        >>> torch.equal(after["reward"], after["task_reward"] - 0.1 * after["guide_distance"])
        True
    """

    alters = "beta"

    def __init__(self, beta: float | Schedule, norm: Literal["l1", "l2", "linf"] = "l2", guide: int = 0) -> None:
        if norm not in ORDERS:
            raise ValueError(f"norm={norm!r} must be one of {', '.join(ORDERS)}")
        super().__init__(["task_reward", "guide_distance"], guide=guide)
        self.beta, self.order = beta, ORDERS[norm]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        reward = next_tensordict["reward"]
        difference = self.space.vectors(tensordict[self.action_key]) - self.advice(tensordict)
        distance = torch.linalg.vector_norm(difference, self.order, -1, keepdim=True).to(reward.dtype)
        next_tensordict.set("task_reward", reward)
        next_tensordict.set("guide_distance", distance)
        if self.training:
            next_tensordict.set("reward", reward - self.now(self.beta) * distance)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for key in self.out_keys:
            tensordict_reset.set(key, self._zero())
        return tensordict_reset

    def _zero(self) -> Tensor:
        zero: Tensor = self.parent.full_reward_spec["reward"].zero()
        return zero

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the two parts of the reward."""
        observation_spec = super().transform_observation_spec(observation_spec)
        reward = self.parent.full_reward_spec["reward"]
        for key in self.out_keys:
            observation_spec[key] = Unbounded(reward.shape, device=reward.device, dtype=reward.dtype)
        return observation_spec
