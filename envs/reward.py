"""Laps and reward of the cone worlds (paper 4.1.1).

The cone world, the driving tasks and the simulated robot share them: an env fills in the `Outcome`
of its step, and `weighted_terms` turns that into the terms whose sum is the reward. The terms are
kept apart until the end, because they are also written under `info` for the analysis of a run.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from coil_rl.envs.constants import constant
from coil_rl.envs.seeded_env import SeededEnv
from coil_rl.envs.track import NEVER, Track, places

HISTORY = 20  # actions that the mean of the roughness is taken over
TERMS = ("finish", "crash", "cone", "smooth", "alive")


class RewardWeights(NamedTuple):
    """Weights of the reward (paper 4.1.1).

    Attributes:
        finish: for a completed lap.
        second: per second of the time of a completed lap.
        crash: in the step of a crash, instead of all other terms.
        cone: for each side with a newly visible cone.
        smooth: per unit of roughness, |a - mean of the last 20 actions|.
        alive: for each step.
    """

    finish: float = 70.0
    second: float = -0.8
    crash: float = -100.0
    cone: float = 2.5
    smooth: float = -0.1
    alive: float = 0.001


class Outcome(NamedTuple):
    """What happened in a step, as far as the reward depends on it.

    Attributes:
        action: [B], fraction of the greatest steering angle.
        roughness: [B], |a - mean of the last 20 actions|.
        lap_time: [B] s, of the lap just completed, else 0.
        finished: [B], whether a lap was completed.
        discovered: [B], number of sides with a newly visible cone.
        to_boundaries: [2, B] m, distances to the left and the right boundary.
        crashed: [B], whether the car crashed.
        alive: [B], 0 after a crash, else 1.
    """

    action: Tensor
    roughness: Tensor
    lap_time: Tensor
    finished: Tensor
    discovered: Tensor
    to_boundaries: Tensor
    crashed: Tensor
    alive: Tensor


def weighted_terms(outcome: Outcome, weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the terms of the paper's reward (4.1.1), [B] each; the reward is their sum.

    Args:
        outcome: what happened in the step.
        weights: by the names of `RewardWeights`, scalars or [B].
    """
    alive = outcome.alive
    bonus = outcome.finished * weights["finish"]
    return {
        "finish": torch.addcmul(bonus, outcome.lap_time, weights["second"]) * alive,
        "crash": outcome.crashed * weights["crash"],
        "cone": outcome.discovered * weights["cone"] * alive,
        "smooth": outcome.roughness * weights["smooth"] * alive,
        "alive": weights["alive"] * alive,
    }


def check_weights(name: str, weights: Mapping[str, float], known: Sequence[str]) -> None:
    """Raise a `ValueError` for unknown weights and for values outside [-1e6, 1e6].

    Args:
        name: of the argument that holds the weights, for the message.
        weights: the weights by name.
    """
    unknown = set(weights) - set(known)
    if unknown:
        raise ValueError(f"{name} has no weight {sorted(unknown)}; it has {', '.join(known)}")
    for key, value in weights.items():
        if not abs(value) <= 1e6:
            raise ValueError(f"{name}.{key}={value} must be between -1e6 and 1e6")


def recent_mean(history: Tensor) -> Tensor:
    """Return the mean of the last actions, weighted by exp(-0.1 k) for the action k steps ago: [B].

    Args:
        history: [20, B], the actions, newest first.
    """
    weights = [math.exp(-0.1 * k) for k in range(HISTORY)]
    shares = constant(tuple(weight / sum(weights) for weight in weights), history)
    # The order of the sum is fixed, while that of `Tensor.sum` depends on the batch size.
    fours = (history * shares).view(2, 2, 5, -1)
    pairs = torch.add(*fours.unbind(0))
    return reduce(torch.add, torch.add(*pairs.unbind(0)).unbind(0))


class LapsEnv(SeededEnv):
    """Cars that drive laps: where they begin, what a step is worth, and when an episode ends.

    A world adds how the cars move and what they see. Its constructor sets the attributes that are
    only declared here, and registers what is known of the P places where an episode may begin as
    `start_NAME`, [..., P], for each of `begun`.

    Attributes:
        reward_terms: names of the terms of the reward.
        begun: state that a place decides.
        rate: steps per second.
        speed: m/s.
        laps: completed laps that end an episode.
        max_steps: of an episode.
        assignment: of places to cars: "random", "drawn" or "cyclic".
        staggered: whether the first episodes of a random assignment begin at different times.
        info: whether to write `info`.
        dtype_: of all floating-point tensors.
    """

    reward_terms: ClassVar[tuple[str, ...]] = TERMS
    begun: ClassVar[tuple[str, ...]] = ("track", "pose", "lap_start", "in_finish")
    rate: float
    speed: float
    laps: int
    max_steps: int
    assignment: str
    staggered: bool
    info: bool = True
    dtype_: torch.dtype = torch.float32

    def _zeros(self, *shape: int, dtype: torch.dtype | None = None) -> nn.Buffer:
        """Return state, [*shape, B]."""
        size = (*shape, *self.batch_size)
        return nn.Buffer(torch.zeros(size, dtype=dtype or self.dtype_, device=self.device))

    def _register_laps(self, reward: Mapping[str, float] | None) -> None:
        """Register the weights of the reward, and the state that all worlds have, as buffers.

        Args:
            reward: weights that are not those of the paper; a `ValueError` for unknown ones.
        """
        check_weights("reward", reward or {}, RewardWeights._fields)
        weights = torch.tensor(RewardWeights(**(reward or {})), dtype=self.dtype_)
        self.weights: Tensor = nn.Buffer(weights.to(self.device), persistent=False)
        self.track: Tensor = self._zeros(dtype=torch.int64)  # index
        self.pose: Tensor = self._zeros(3)  # m, m, radians
        self.history: Tensor = self._zeros(HISTORY)  # actions, newest first
        self.steps: Tensor = self._zeros(dtype=torch.int32)  # of the episode
        self.lap: Tensor = self._zeros(dtype=torch.int32)  # completed laps
        # Step of the last entry of the finish circle.
        self.lap_start: Tensor = self._zeros(dtype=torch.int32)
        self.in_finish: Tensor = self._zeros(dtype=torch.bool)  # whether inside the finish circle

    def _places(self, tracks: Sequence[Track], starts: int | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return track [P], pose [3, P] and `lap_start` [P] of the places where episodes begin."""
        index, pose, driven = map(torch.as_tensor, places(tracks, starts))
        # A negative step: the one at which a car at full speed would have been at the finish.
        lap_start = torch.where(driven.isnan(), NEVER, -driven * self.rate / self.speed)
        pose = pose.T.contiguous().to(self.device, self.dtype_)
        return index.to(self.device), pose, lap_start.round().int().to(self.device)

    def _begin(
        self, tensordict: TensorDictBase | None
    ) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Write the state at the start of an episode.

        Args:
            tensordict: with the entry `_reset`, the mask of the cars that are reset; else all are.

        Returns:
            Indices of the cars that are reset, [N]; and a function of a table over all places
            [..., P] that returns the columns of these cars.
        """
        mask = None if tensordict is None else tensordict.get("_reset", None)
        everyone = torch.arange(self.batch_size[0], device=self.device)
        cars = everyone if mask is None else mask.view(-1).nonzero().squeeze(-1)
        place, steps = self._assign_places(cars, first=mask is None)

        def start(of_places: Tensor) -> Tensor:
            return of_places.index_select(-1, place)

        copied = {name: start(getattr(self, f"start_{name}")) for name in self.begun}
        copied |= {"steps": steps, "lap_start": steps + copied["lap_start"]}
        for name, value in copied.items():
            setattr(self, name, getattr(self, name).index_copy(-1, cars, value))
        for name in ("history", "lap"):
            setattr(self, name, getattr(self, name).index_fill(-1, cars, 0))
        return cars, start

    def _assign_places(self, cars: Tensor, *, first: bool) -> tuple[Tensor, Tensor]:
        """Choose where cars begin their episodes.

        Args:
            cars: [N], indices of the cars that are reset.
            first: whether this is a reset of all cars, not of those whose episodes ended.

        Returns:
            The place of each car, and the number of steps of its time limit that are over, [N]
            each.
        """
        count = self.start_track.shape[-1]
        steps = torch.zeros_like(cars, dtype=self.steps.dtype)
        if self.assignment == "cyclic":
            return cars % count, steps
        # One draw per car, reset or not, keeps the random sequence independent of the data.
        drawn = self._drawn(count)
        place = drawn.to(self.device).index_select(0, cars)
        if first and self.staggered and self.assignment == "random":
            over = self._drawn(self.max_steps)
            steps = over.to(steps)
        return place, steps

    def _first(self, entries: Mapping[str, Tensor]) -> TensorDict:
        """Return the entries after a reset, of which a world gives those that it observes."""
        zero = torch.zeros_like(self.pose[0])
        flags = {"crashed": zero.bool(), "completed": zero.bool()}
        info = {"lap_time": zero, **flags, "clearance": zero, "smoothness": zero}
        return self._output(entries, info, dict.fromkeys(self.reward_terms, zero))

    def _act(self, action: Tensor) -> Tensor:
        """Note actions [B] and the step, and return the roughness [B]."""
        roughness = (action - recent_mean(self.history)).abs_()
        self.history = torch.cat([action.unsqueeze(0), self.history[:-1]])
        self.steps = self.steps + constant(1, self.steps)
        return roughness

    def _count_laps(self, inside: Tensor) -> tuple[Tensor, Tensor]:
        """Count laps; return lap time and whether a lap was completed, [B] each.

        The lap time is in s, 0 unless a lap was completed.

        Args:
            inside: [B], whether each car is in the finish circle.
        """
        entered = inside & ~self.in_finish
        finished = entered & (self.lap_start > constant(NEVER, self.lap_start))
        lap_time = (self.steps - self.lap_start) * finished / constant(self.rate, self.pose)
        self.in_finish = inside
        self.lap_start = torch.where(entered, self.steps, self.lap_start)
        self.lap = self.lap + finished
        return lap_time, finished

    def _judged(
        self, entries: Mapping[str, Tensor], clearance: Tensor, **happened: Tensor
    ) -> TensorDict:
        """Return the entries after a step, with its reward and the ends of episodes.

        Args:
            entries: that the world observes.
            clearance: [B] m, distance to a crash; at most 0 for a crash.
            happened: the other values of an `Outcome`.
        """
        crashed = clearance <= constant(0, clearance)
        alive = (~crashed).to(clearance.dtype)
        outcome = Outcome(**happened, crashed=crashed, alive=alive)
        terms = self._reward(outcome)
        completed = (self.lap >= constant(self.laps, self.lap)) & ~crashed
        terminated = crashed | completed
        truncated = (self.steps >= constant(self.max_steps, self.steps)) & ~terminated
        info = {
            "lap_time": outcome.lap_time,
            "crashed": crashed,
            "completed": completed,
            "clearance": clearance,
            "smoothness": outcome.roughness,
        }
        return self._output(
            entries,
            info,
            terms,
            reward=reduce(torch.add, terms.values()).to(clearance.dtype),
            terminated=terminated,
            truncated=truncated,
            done=terminated | truncated,
        )

    def _reward(self, outcome: Outcome) -> dict[str, Tensor]:
        """Return the terms of the reward, [B] each."""
        weights = dict(zip(RewardWeights._fields, self.weights.unbind(0), strict=True))
        return weighted_terms(outcome, weights)

    def _output(
        self,
        entries: Mapping[str, Tensor],
        info: Mapping[str, Tensor],
        terms: Mapping[str, Tensor],
        **ends: Tensor,
    ) -> TensorDict:
        """Put the entries of a reset or a step together.

        Args:
            entries: that the world observes, [B, ...] each.
            info: entries of `info` that are no state, [B] each.
            terms: terms of the reward, [B] each.
            ends: reward and ends of episodes after a step, [B] each; none after a reset.
        """
        data: dict[str, Any] = {**entries, "steering": self.history[0].unsqueeze(-1)}
        data |= {key: value.unsqueeze(-1) for key, value in ends.items()}
        if self.info:
            info = {"track": self.track, "lap": self.lap.long(), **info}
            noted: dict[str, Any] = {key: value.unsqueeze(-1) for key, value in info.items()}
            rewards = {key: value.to(self.dtype_).unsqueeze(-1) for key, value in terms.items()}
            noted["pose"] = self.pose.t()
            noted["reward"] = TensorDict(rewards, self.batch_size, device=self.device)
            data["info"] = TensorDict(noted, self.batch_size, device=self.device)
        return TensorDict(data, self.batch_size, device=self.device)
