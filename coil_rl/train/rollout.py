"""Collects experience: steps an env with a policy and remembers where it stopped."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from coil_rl.train.finite import check_batch
from coil_rl.transforms.guide_transform import GuideTransform


class Rollout:
    """Batches of consecutive steps of every row of an env, resetting each row that is done.

    Args:
        env: batched env; its transforms go into training mode.
        policy: writes the action; it samples.
        steps: T, length of a batch.
        keys: entries to keep, of those after a step as `("next", ...)`; all of them by default.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.guides import SplineGuide
        >>> Rollout(ConeTrackEnv(shipped_tracks("train"), 8), SplineGuide(), steps=4).collect().shape
        torch.Size([8, 4])
    """

    def __init__(
        self, env: EnvBase, policy: TensorDictModuleBase, steps: int, keys: Sequence[NestedKey] | None = None
    ) -> None:
        self.env, self.policy, self.steps = env.train(), policy, steps
        self.guided = [module for module in env.modules() if isinstance(module, GuideTransform)]
        self.keys = None if keys is None else list(dict.fromkeys(keys))
        self.carrier: TensorDictBase | None = None
        self.taken = 0  # steps of each row

    @property
    def frames(self) -> int:
        """Frames in a batch, B * T."""
        return self.env.batch_size.numel() * self.steps

    @torch.no_grad()
    def collect(self, progress: float = 0.0) -> TensorDictBase:
        """The next batch, [B, T].

        Args:
            progress: share of the run that is over, for the schedules of transforms.

        Raises:
            UserError: if a number in it is NaN or infinite, naming the entry, the step and the row.
        """
        for transform in self.guided:
            transform.progress = progress
        carrier = self.env.reset() if self.carrier is None else self.carrier
        columns: dict[NestedKey, list[Tensor]] = {}
        try:
            with set_exploration_type(ExplorationType.RANDOM):
                for _ in range(self.steps):
                    step, carrier = self.env.step_and_maybe_reset(self.policy(carrier))
                    for key in self.keys or step.keys(True, True):
                        columns.setdefault(key, []).append(step[key])
        except Exception:
            # An env may break over the NaN that it wrote a step ago, and that NaN is what a person must hear of.
            check_batch(self._stacked(columns), self.taken)
            check_batch(carrier.unsqueeze(-1), self.taken + max(map(len, columns.values()), default=0))
            raise
        batch = self._stacked(columns)
        check_batch(batch, self.taken)
        self.carrier = carrier
        self.taken += self.steps
        return batch

    def _stacked(self, columns: Mapping[NestedKey, list[Tensor]]) -> TensorDictBase:
        time = len(self.env.batch_size)
        steps = min(map(len, columns.values()), default=0)
        batch = TensorDict({}, (*self.env.batch_size, steps), device=self.env.device)
        for key, column in columns.items():
            batch[key] = torch.stack(column[:steps], time)
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Where the env and the collection stand."""
        env = self.env.base_env if isinstance(self.env, TransformedEnv) else self.env
        return {
            "env": env.state_dict(),
            "transforms": self.env.state_dict() if env is not self.env else {},
            "carrier": None if self.carrier is None else self.carrier.to_dict(),
            "taken": self.taken,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state of `state_dict`."""
        env = self.env.base_env if isinstance(self.env, TransformedEnv) else self.env
        env.load_state_dict(state["env"])
        if env is not self.env:
            self.env.load_state_dict(state["transforms"])
        carrier = state["carrier"]
        if carrier is not None:
            carrier = TensorDict.from_dict(carrier, batch_size=self.env.batch_size, device=self.env.device)
        self.carrier, self.taken = carrier, state["taken"]
