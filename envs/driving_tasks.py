"""The cone world with driving tasks: the weights of the reward change within the episode.

Each car has a task, such as keeping to the left, which is a set of weights of the reward. The task
is observed and changes at random, so one agent has to learn all tasks, as in the puppeteer example
of Dynamic COIL: one guide per task, and one agent that learns from all guides.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import OneHot

from coil_rl.envs.cone_track import ConeTrackEnv
from coil_rl.envs.reward import TERMS, Outcome, RewardWeights, check_weights, weighted_terms
from coil_rl.envs.seeded_env import declare_specs
from coil_rl.envs.sight import SIGHT
from coil_rl.envs.track import Track


class PositionWeights(NamedTuple):
    """Weights of the lateral position.

    The position is 1 at the left boundary, 0 in the middle and -1 at the right boundary.

    Attributes:
        centre: per step and unit of |position|.
        left: per step and unit of position.
        inside: per step and unit of position times action, which is positive on the inner side of a
            bend.
    """

    centre: float = 0.0
    left: float = 0.0
    inside: float = 0.0


WEIGHTS = (*RewardWeights._fields, *PositionWeights._fields)


class DrivingTasksEnv(ConeTrackEnv):
    """Cars on tracks between cones, each with a task that changes.

    Writes in addition to `ConeTrackEnv`: `task` [B, tasks], one-hot, the task of the next step; and
    under `info`: `task`, with one entry [B, 1] per task, whether the step was rewarded by it, and
    in `reward` the terms of `PositionWeights`.

    Args:
        tasks: name of each task to its weights, by the names of `RewardWeights` and
            `PositionWeights`; at least one task.
        only: a task that all cars keep; by default they change between all tasks.
        duration: s, mean time until a task changes to another one, drawn every step with equal
            probabilities; at least one step.
        reward: weights that a task does not set; those that are not here either are those of the
            paper, and 0 for the lateral position.
        starts: number of places where an episode may begin, as explained for `ConeTrackEnv`; None
            for the starts of the tracks.
        assignment: "random" draws a place at each reset, "cyclic" keeps car i on place i mod
            places.
        hold_boundary: whether the boundary estimate stays in place until a cone comes into view.
        finish_in_sight: whether the finish line is between the first cones that are visible from
            the track's start, in place of the first cones of the level file.
        seed: of the draws of places and tasks, at least 0.

    Raises:
        ValueError: for a value outside its range, an unknown weight or an unknown task.

    Example:
        >>> from coil_rl.envs import DrivingTasksEnv, shipped_tracks
        >>> tasks = {"centred": {"centre": -1.0}, "left": {"left": 0.5}, "right": {"left": -0.5}}
        >>> env = DrivingTasksEnv(shipped_tracks("train"), num_envs=8, tasks=tasks)
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
        rate: float = 24.0,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        cone_bonus: Literal["first_sighting", "every_sighting"] = "first_sighting",
        laps: int = 2,
        time_limit: float = 200.0,
        held_steps: int = 0,
        starts: int | None = None,
        assignment: Literal["random", "drawn", "cyclic"] = "random",
        sight: float = SIGHT,
        hold_boundary: bool = False,
        finish_in_sight: bool = False,
        kept_cones: int = 16,
        speed: float = 2.0,
        car_length: float = 2.0,
        max_steering: float = 80.0,
        info: bool = True,
        seed: int = 0,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
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
        # The weights of the base class stay unused: here they depend on the task of each car.
        super().__init__(
            tracks,
            num_envs,
            rate=rate,
            spline=spline,
            smoothing=smoothing,
            cone_bonus=cone_bonus,
            laps=laps,
            time_limit=time_limit,
            held_steps=held_steps,
            starts=starts,
            assignment=assignment,
            sight=sight,
            hold_boundary=hold_boundary,
            finish_in_sight=finish_in_sight,
            kept_cones=kept_cones,
            speed=speed,
            car_length=car_length,
            max_steering=max_steering,
            info=info,
            seed=seed,
            device=device,
            dtype=dtype,
        )
        if not duration * self.rate >= 1:
            raise ValueError(f"duration={duration} must be at least one step of 1/{self.rate} s")
        self.tasks, self.duration = tuple(tasks), duration
        self.changing = only is None and len(tasks) > 1
        table = _weight_table(tasks, reward)
        self.task_weights: Tensor = nn.Buffer(
            torch.tensor(table, dtype=dtype, device=self.device), persistent=False
        )
        self.one_hot: Tensor = nn.Buffer(
            torch.eye(len(tasks), dtype=dtype, device=self.device), persistent=False
        )
        first = 0 if only is None else self.tasks.index(only)
        self.task: Tensor = nn.Buffer(torch.full(self.batch_size, first, device=self.device))
        declare_specs(self, self._reset())
        shape = (*self.batch_size, len(tasks))
        self.observation_spec["task"] = OneHot(shape[-1], shape, dtype=dtype, device=self.device)
        self.set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        out = super()._reset(tensordict, **kwargs)
        if self.changing:
            # One draw per car, reset or not, as for the tracks.
            drawn = self._drawn(len(self.tasks))
            drawn = drawn.to(self.device, non_blocking=True)
            mask = None if tensordict is None else tensordict.get("_reset", None)
            self.task = drawn if mask is None else torch.where(mask.view(-1), drawn, self.task)
        return self._add_task(out, self.task)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._step(tensordict)
        rewarded = self.task
        if self.changing:
            self.task = self._next_task()
        return self._add_task(out, rewarded)

    def _next_task(self) -> Tensor:
        """Return the tasks of the next step, [B].

        One draw per car decides both about the change and about the new task: its lowest values
        stand for the other tasks, all higher ones for no change.
        """
        drawn = self._for_all_rows(torch.rand(self._drawing_rows, generator=self.generator))
        drawn = drawn.to(self.device, non_blocking=True)
        others = len(self.tasks) - 1
        shift = (drawn * (self.duration * self.rate * others)).floor_().to(self.task.dtype) + 1
        return torch.where(shift <= others, (self.task + shift) % len(self.tasks), self.task)

    def _reward(self, outcome: Outcome) -> dict[str, Tensor]:
        rows = self.task_weights.index_select(1, self.task).unbind(0)
        weights = dict(zip(WEIGHTS, rows, strict=True))
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


def _weight_table(
    tasks: Mapping[str, Mapping[str, float]], reward: Mapping[str, float]
) -> list[list[float]]:
    """Return the weights of all tasks, one row per weight and one column per task.

    Args:
        reward: weights that a task does not set.
    """
    common = RewardWeights()._asdict() | PositionWeights()._asdict() | dict(reward)
    complete = [common | dict(weights) for weights in tasks.values()]
    return [[weights[key] for weights in complete] for key in WEIGHTS]
