"""The cone world with driving tasks: the weights of the reward change within the episode.

Each car has a task, such as keeping to the left, which is a set of weights of the reward. The task
is observed and changes at random, so one agent has to learn all tasks, as in the puppeteer example
of Dynamic COIL: one guide per task, and one agent that learns from all guides.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Composite, OneHot

from coil_rl.envs.cone_track import ConeTrackEnv
from coil_rl.envs.reward import TERMS, Outcome, RewardWeights, check_weights, weighted_terms
from coil_rl.envs.track import Track


class PositionWeights(NamedTuple):
    """Weights of the lateral position: 1 at the left boundary, 0 in the middle, -1 at the right boundary."""

    centre: float = 0.0  # per step and unit of |position|
    left: float = 0.0  # per step and unit of position
    inside: float = (
        0.0  # per step and unit of position times action, positive on the inner side of a bend
    )


WEIGHTS = (*RewardWeights._fields, *PositionWeights._fields)


class DrivingTasksEnv(ConeTrackEnv):
    """Cars on tracks between cones, each with a task that changes.

    Writes in addition to `ConeTrackEnv`: `task` [B, tasks], one-hot, the task of the next step; and
    under `info`: `task`, with one entry [B, 1] per task, whether the step was rewarded by it, and
    in `reward` the terms of `PositionWeights`.

    Args:
        tracks, num_envs, world: as for `ConeTrackEnv`.
        tasks: name to weights, of `RewardWeights` and `PositionWeights`.
        only: a task that all cars keep; by default they change between all tasks.
        duration: s, mean time until a task changes to another one, drawn every step with equal
            probabilities.
        reward: weights that a task does not set.

    Example:
        >>> from coil_rl.envs import DrivingTasksEnv, shipped_tracks
        >>> tasks = {"centred": {"centre": -1.0}, "left": {"left": 0.5}, "right": {"left": -0.5}}
        >>> env = DrivingTasksEnv(shipped_tracks("train"), num_envs=8, tasks=tasks, reward={"alive": 0.5})
        >>> env.rollout(3, break_when_any_done=False)["task"].shape
        torch.Size([8, 3, 3])
    """

    reward_terms: ClassVar[tuple[str, ...]] = (*TERMS, *PositionWeights._fields)

    def __init__(
        self,
        tracks: Sequence[Track],
        num_envs: int = 64,
        *,
        tasks: Mapping[str, Mapping[str, float]],
        only: str | None = None,
        duration: float = 10.0,
        reward: Mapping[str, float] | None = None,
        **world: Any,
    ) -> None:
        reward = reward or {}
        check_weights("reward", reward, WEIGHTS)
        for name, weights in tasks.items():
            check_weights(f"tasks.{name}", weights, WEIGHTS)
        if not tasks:
            raise ValueError(
                "tasks is empty; give at least one, such as tasks={centred: {centre: -1.0}}"
            )
        if only is not None and only not in tasks:
            raise ValueError(f"only={only!r} must be one of {', '.join(tasks)}")
        super().__init__(tracks, num_envs, **world)
        if not duration * self.rate >= 1:
            raise ValueError(f"duration={duration} must be at least one step of 1/{self.rate} s")
        self.tasks, self.duration = tuple(tasks), duration
        self.changing = only is None and len(tasks) > 1
        common = RewardWeights()._asdict() | PositionWeights()._asdict() | dict(reward)
        table = [[(common | dict(weights))[key] for weights in tasks.values()] for key in WEIGHTS]
        options = {"dtype": self.dtype_, "device": self.device}
        self.task_weights: Tensor = nn.Buffer(torch.tensor(table, **options), persistent=False)
        self.one_hot: Tensor = nn.Buffer(torch.eye(len(tasks), **options), persistent=False)
        first = 0 if only is None else self.tasks.index(only)
        self.task: Tensor = nn.Buffer(torch.full(self.batch_size, first, device=self.device))
        self.observation_spec["task"] = OneHot(
            len(tasks), (*self.batch_size, len(tasks)), **options
        )
        if self.info:
            flag = Binary(1, (*self.batch_size, 1), dtype=torch.bool, device=self.device)
            self.observation_spec["info", "task"] = Composite(
                dict.fromkeys(self.tasks, flag), shape=self.batch_size
            )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        out = super()._reset(tensordict, **kwargs)
        if self.changing:
            # One draw per car, reset or not, as for the tracks.
            drawn = torch.randint(len(self.tasks), self.batch_size, generator=self.generator)
            drawn = drawn.to(self.device, non_blocking=True)
            mask = None if tensordict is None else tensordict.get("_reset", None)
            self.task = drawn if mask is None else torch.where(mask.view(-1), drawn, self.task)
        return self._add_task(out, self.task)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out, rewarded = super()._step(tensordict), self.task
        if self.changing:
            self.task = self._next_task()
        return self._add_task(out, rewarded)

    def _next_task(self) -> Tensor:
        """Return the tasks of the next step [B]; one draw per car decides about the change and the new task."""
        drawn = torch.rand(self.batch_size, generator=self.generator).to(
            self.device, non_blocking=True
        )
        others = len(self.tasks) - 1
        shift = (drawn * (self.duration * self.rate * others)).floor_().to(self.task.dtype) + 1
        return torch.where(shift <= others, (self.task + shift) % len(self.tasks), self.task)

    def _reward(self, outcome: Outcome) -> dict[str, Tensor]:
        weights = dict(
            zip(WEIGHTS, self.task_weights.index_select(1, self.task).unbind(0), strict=True)
        )
        to_left, to_right = outcome.to_boundaries
        position = (to_right - to_left) / (to_right + to_left)
        terms = {"centre": position.abs(), "left": position, "inside": position * outcome.action}
        weighted = {term: value * weights[term] * outcome.alive for term, value in terms.items()}
        return weighted_terms(outcome, weights) | weighted

    def _add_task(self, out: TensorDictBase, rewarded: Tensor) -> TensorDictBase:
        """Add the task of the next step to the observations, and the rewarded task to `info`."""
        out["task"] = self.one_hot.index_select(0, self.task)
        if self.info:
            flags = self.one_hot.index_select(0, rewarded).bool().split(1, -1)
            entries = dict(zip(self.tasks, flags, strict=True))
            out["info", "task"] = TensorDict(entries, self.batch_size, device=self.device)
        return out
