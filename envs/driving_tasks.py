"""The cone world with several ways to drive it: what is paid changes within the episode, and the agent is told.

Every car has a task, such as to keep to the left. A task is a set of weights of the reward. Which one holds is part of
what the car sees and changes at random moments, so that one agent has to learn them all, as in the puppeteer example
of Dynamic COIL: a guide for each task, and an agent that learns from all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, OneHot

from coil_rl.envs.cone_track import ConeTrackEnv
from coil_rl.envs.reward import REWARD_TERMS, Outcome, Reward, check_weights, pay
from coil_rl.envs.track import Track


class Place(NamedTuple):
    """Weights of where the car is across the track: 1 is the left boundary, 0 the middle, -1 the right one.

    Attributes:
        centre: paid every step per unit of |place|.
        left: paid every step per unit of place.
        inside: paid every step per unit of place times action, which is more than 0 on the inner side of a bend. It
            pays nobody to weave: what the steering to one side brings, the steering back costs, and more.
    """

    centre: float = 0.0
    left: float = 0.0
    inside: float = 0.0


WEIGHTS = (*Reward._fields, *Place._fields)


class DrivingTasksEnv(ConeTrackEnv):
    """Cars on tracks between cones, each with a task that changes.

    Writes besides all that `ConeTrackEnv` does: `task` [B, tasks], 1 at the task that the next step is paid by and else
    0; and under `info`: `task`, with one entry [B, 1] a task, whether the step was paid by it, and in `reward` the
    terms of `Place`.

    Args:
        tracks: where to drive.
        num_cars: B.
        tasks: name to weights, of `Reward` and `Place`; what a task does not mention is as in `reward`.
        only: the one task that all cars have all the time; None for all of them in turn. The others still have their
            place in `task`.
        duration: s, mean time until a task gives way to another one, all alike probable. Whether it does is drawn
            every step, so that nothing tells how long it will last.
        reward: weights that all tasks have, see `Reward` and `Place`.
        world: all else that `ConeTrackEnv` takes.

    Raises:
        ValueError: as `ConeTrackEnv`, and for tasks and weights that do not exist.

    Example:
        >>> from coil_rl.envs import DrivingTasksEnv, shipped_tracks
        >>> tasks = {"centred": {"centre": -1.0}, "left": {"left": 0.5}, "right": {"left": -0.5}}
        >>> env = DrivingTasksEnv(shipped_tracks("train"), num_cars=8, tasks=tasks, reward={"alive": 0.5})
        >>> env.rollout(3, break_when_any_done=False)["task"].shape
        torch.Size([8, 3, 3])
    """

    reward_terms: ClassVar[tuple[str, ...]] = (*REWARD_TERMS, *Place._fields)

    task: Tensor
    task_weights: Tensor
    one_hot: Tensor

    def __init__(
        self,
        tracks: Sequence[Track],
        num_cars: int = 64,
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
            raise ValueError("tasks is empty; give at least one, such as tasks={centred: {centre: -1.0}}")
        if only is not None and only not in tasks:
            raise ValueError(f"only={only!r} must be one of {', '.join(tasks)}")
        super().__init__(tracks, num_cars, **world)
        if not duration * self.rate >= 1:
            raise ValueError(f"duration={duration} must be at least one step of 1/{self.rate} s")
        self.tasks = tuple(tasks)
        self.only = None if only is None else self.tasks.index(only)
        self.duration = duration
        usual = Reward()._asdict() | Place()._asdict() | dict(reward)
        table = [[(usual | dict(weights))[key] for weights in tasks.values()] for key in WEIGHTS]
        fixed = {"dtype": self.dtype_, "device": self.device}
        self.register_buffer("task_weights", torch.tensor(table, **fixed), persistent=False)
        self.register_buffer("one_hot", torch.eye(len(self.tasks), **fixed), persistent=False)
        self.register_buffer("task", torch.full(self.batch_size, self.only or 0, device=self.device))
        shape = (*self.batch_size, len(self.tasks))
        self.observation_spec["task"] = OneHot(len(self.tasks), shape, dtype=self.dtype_, device=self.device)
        if self.info:
            flag = Binary(1, (*self.batch_size, 1), dtype=torch.bool, device=self.device)
            self.observation_spec["info", "task"] = Composite(dict.fromkeys(self.tasks, flag), shape=self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        out = super()._reset(tensordict, **kwargs)
        if self._changes():
            # All cars draw, reset or not, as the base class does for the tracks.
            drawn = torch.randint(len(self.tasks), self.batch_size, generator=self.generator)
            drawn = drawn.to(self.device, non_blocking=True)
            mask = None if tensordict is None else tensordict.get("_reset", None)
            self.task = drawn if mask is None else torch.where(mask.view(-1), drawn, self.task)
        return self._tell(out, self.task)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._step(tensordict)
        paid = self.task
        if self._changes():
            self.task = self._next()
        return self._tell(out, paid)

    def _changes(self) -> bool:
        return self.only is None and len(self.tasks) > 1

    def _next(self) -> Tensor:
        """The tasks [B] of the next step: another one once in `duration`, by a single draw a car."""
        drawn = torch.rand(self.batch_size, generator=self.generator).to(self.device, non_blocking=True)
        others = len(self.tasks) - 1
        on = (drawn * (self.duration * self.rate * others)).floor_().to(self.task.dtype) + 1
        return torch.where(on <= others, (self.task + on) % len(self.tasks), self.task)

    def _pay(self, outcome: Outcome) -> dict[str, Tensor]:
        weights = dict(zip(WEIGHTS, self.task_weights.index_select(1, self.task).unbind(0), strict=True))
        to_left, to_right = outcome.to_boundaries
        place = (to_right - to_left) / (to_right + to_left)
        paid = {"centre": place.abs(), "left": place, "inside": place * outcome.action}
        return pay(outcome, weights) | {term: value * weights[term] * outcome.alive for term, value in paid.items()}

    def _tell(self, out: TensorDictBase, paid: Tensor) -> TensorDictBase:
        """Add the task that holds now to what the agent sees, and the one that was paid to `info`."""
        out["task"] = self.one_hot.index_select(0, self.task)
        if self.info:
            was = self.one_hot.index_select(0, paid).bool().split(1, -1)
            entries = dict(zip(self.tasks, was, strict=True))
            out["info", "task"] = TensorDict(entries, self.batch_size, device=self.device)
        return out
