"""The cone world of the paper (section 4.1) as a batched TorchRL env.

Every car of the batch drives on a closed track between two rings of cones at constant speed and chooses its steering.
It sees the cones ahead, is paid for laps, new cones and staying alive, and pays for jerky steering and crashes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial, reduce
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from coil_rl.envs.constants import constant
from coil_rl.envs.reward import HISTORY, REWARD_TERMS, Outcome, Reward, check_weights, pay, recent_mean
from coil_rl.envs.seeded import SeededEnv
from coil_rl.envs.sight import SAMPLES, Frame, View, boundary_samples, encode, view
from coil_rl.envs.splines import quadratic_spline, smoothing_spline
from coil_rl.envs.track import Track
from coil_rl.envs.track_map import Place, TrackMap

FINISH_RADIUS = 0.625  # m


class ConeTrackEnv(SeededEnv):
    """Cars on tracks between cones.

    Reads `action` [B, 1], the steering angle as a fraction of 80 degrees. Writes `observation` [B, 20], `cones`
    [B, 2, K, 2] m in the car's frame nearest first, `cone_count` [B, 2], `steering` [B, 1] the action now in force,
    `reward`, `done`, `terminated`, `truncated` [B, 1], and for evaluation only, under `info`: `track`, `lap` (completed
    laps), `lap_time` s (of the lap just completed, else 0), `crashed`, `clearance` m (to the nearest crash),
    `smoothness` |a - a_avg|, `pose` [B, 3] (m, m, radians) and the terms of the reward, one entry each. All state is
    in buffers, so `state_dict()` is the whole of it.

    Args:
        tracks: where to drive.
        num_cars: B.
        rate: control steps per second.
        spline: of the boundary estimate, "cubic" (smoothing) or "quadratic" (interpolating).
        smoothing: lambda of the cubic smoothing spline, m^3.
        cone_bonus: "first_sighting" pays a cone once a lap, "every_sighting" whenever it was not in view a step ago.
        reward: weights, see `Reward`.
        laps: completed laps that end an episode.
        time_limit: s, then an episode is truncated.
        held_steps: for so many first steps of an episode the steering is held at 0.
        assignment: "random" draws a track at each reset, "cyclic" keeps car i on track i mod len(tracks).
        kept_cones: K.
        speed: m/s.
        car_length: m.
        max_steering: degrees of an action of 1.
        info: False leaves `info` out, where nobody reads it.
        seed: of the draw of tracks.
        device: where everything lives.
        dtype: of everything that is not a count.

    Raises:
        ValueError: for a value outside its range, naming it.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=8)
        >>> env.rollout(3, break_when_any_done=False)["next", "observation"].shape
        torch.Size([8, 3, 20])
    """

    reward_terms: ClassVar[tuple[str, ...]] = REWARD_TERMS

    weights: Tensor
    track: Tensor
    pose: Tensor
    history: Tensor
    steps: Tensor
    lap: Tensor
    clock: Tensor
    on_line: Tensor
    epoch: Tensor
    seen_in: Tensor
    samples: Tensor
    sampled: Tensor
    start_cones: Tensor
    start_count: Tensor
    start_observation: Tensor
    start_samples: Tensor
    start_sampled: Tensor

    def __init__(
        self,
        tracks: Sequence[Track],
        num_cars: int = 64,
        *,
        rate: float = 24.0,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        cone_bonus: Literal["first_sighting", "every_sighting"] = "first_sighting",
        reward: dict[str, float] | None = None,
        laps: int = 2,
        time_limit: float = 200.0,
        held_steps: int = 0,
        assignment: Literal["random", "cyclic"] = "random",
        kept_cones: int = 16,
        speed: float = 2.0,
        car_length: float = 2.0,
        max_steering: float = 80.0,
        info: bool = True,
        seed: int = 0,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        _check_choice("spline", spline, ("cubic", "quadratic"))
        _check_choice("cone_bonus", cone_bonus, ("first_sighting", "every_sighting"))
        _check_choice("assignment", assignment, ("random", "cyclic"))
        positive = {
            "num_cars": num_cars, "rate": rate, "laps": laps, "time_limit": time_limit, "kept_cones": kept_cones,
            "speed": speed, "car_length": car_length, "max_steering": max_steering,
        }  # fmt: skip
        for name, value in positive.items():
            if not value > 0:
                raise ValueError(f"{name}={value} must be more than 0")
        for name, value in {"held_steps": held_steps, "seed": seed}.items():
            if value < 0:
                raise ValueError(f"{name}={value} must be at least 0")
        if round(time_limit * rate) < 1:
            raise ValueError(f"time_limit={time_limit} must be at least one step of 1/{rate} s")
        if max_steering > 90:
            raise ValueError(f"max_steering={max_steering} must be at most 90 degrees")
        check_weights("reward", reward or {}, Reward._fields)
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_cars]))
        self.dtype_ = dtype
        self.rate, self.laps, self.held_steps, self.assignment = rate, laps, held_steps, assignment
        self.info = info
        self.max_steps = round(time_limit * rate)
        self.every_sighting = cone_bonus == "every_sighting"
        self.kept_cones, self.speed, self.car_length = kept_cones, speed, car_length
        self.max_steering = math.radians(max_steering)
        self.fit = partial(smoothing_spline, smoothing=smoothing) if spline == "cubic" else quadratic_spline
        self.map = TrackMap(tracks, dtype=dtype).to(self.device)
        self.generator = torch.Generator()
        weights = torch.tensor(Reward(**(reward or {})), dtype=dtype, device=self.device)
        self.register_buffer("weights", weights, persistent=False)
        self._declare_specs()
        self._allocate(num_cars)
        self.set_seed(seed)

    # State: one row of numbers per quantity, the cars last.

    def _allocate(self, cars: int) -> None:
        def keep(name: str, *shape: int, dtype: torch.dtype = self.dtype_) -> None:
            self.register_buffer(name, torch.zeros(shape, dtype=dtype, device=self.device))

        keep("track", cars, dtype=torch.int64)
        keep("pose", 3, cars)
        keep("history", HISTORY, cars)
        keep("steps", cars, dtype=torch.int32)
        keep("lap", cars, dtype=torch.int32)
        keep("clock", cars, dtype=torch.int32)
        keep("on_line", cars, dtype=torch.bool)
        keep("epoch", cars, dtype=torch.int32)
        keep("seen_in", 2 * self.map.slots, cars, dtype=torch.int32)
        keep("samples", 2, SAMPLES, 2, cars)
        keep("sampled", 2, cars)

        # What a car sees at the start depends on its track alone, so a reset only copies it.
        tracks = torch.arange(len(self.map), device=self.device)
        samples = torch.zeros(2, SAMPLES, 2, len(tracks), dtype=self.dtype_, device=self.device)
        sampled = torch.zeros(2, len(tracks), dtype=self.dtype_, device=self.device)
        frame = Frame(self.map.starts)
        seen, _ = self._look(self.map.locate(tracks, frame.position), self.map.starts, frame)
        observation, samples, sampled = self._observe(frame, seen, samples, sampled)
        for name, value in {
            "start_cones": self._padded(seen.cones), "start_count": seen.count.long(),
            "start_observation": observation.t(), "start_samples": samples, "start_sampled": sampled,
        }.items():  # fmt: skip
            self.register_buffer(name, value, persistent=False)

    # Specs

    def _declare_specs(self) -> None:
        def real(*shape: int) -> Unbounded:
            return Unbounded((*self.batch_size, *shape), dtype=self.dtype_, device=self.device)

        def whole(*shape: int) -> Unbounded:
            return Unbounded((*self.batch_size, *shape), dtype=torch.int64, device=self.device)

        def flag() -> Binary:
            return Binary(1, shape=(*self.batch_size, 1), dtype=torch.bool, device=self.device)

        def bounded(*shape: int) -> Bounded:
            return Bounded(-1, 1, (*self.batch_size, *shape), dtype=self.dtype_, device=self.device)

        info = Composite(
            track=whole(1), lap=whole(1), lap_time=real(1), crashed=flag(), clearance=real(1), smoothness=real(1),
            pose=real(3), reward=Composite({term: real(1) for term in self.reward_terms}, shape=self.batch_size),
            shape=self.batch_size,
        )  # fmt: skip
        self.observation_spec = Composite(
            observation=bounded(4 * SAMPLES), cones=real(2, self.kept_cones, 2), cone_count=whole(2),
            steering=bounded(1), shape=self.batch_size,
        )  # fmt: skip
        if self.info:
            self.observation_spec["info"] = info
        self.action_spec = bounded(1)
        self.reward_spec = real(1)
        self.done_spec = Composite(
            {key: flag() for key in ("done", "terminated", "truncated")}, shape=self.batch_size, device=self.device
        )

    # Dynamics

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        everyone = torch.arange(self.batch_size[0], device=self.device)
        cars = everyone if mask is None else mask.view(-1).nonzero().squeeze(-1)
        if self.assignment == "cyclic":
            track = cars % len(self.map)
        else:
            # All cars draw, reset or not: which numbers come next must not depend on the data.
            drawn = torch.randint(len(self.map), self.batch_size, generator=self.generator)
            track = drawn.to(self.device).index_select(0, cars)

        def put(state: Tensor, value: Tensor | float) -> Tensor:
            if isinstance(value, Tensor):
                return state.index_copy(-1, cars, value)
            return state.index_fill(-1, cars, value)

        def start(at: Tensor) -> Tensor:
            return at.index_select(-1, track)

        self.track = put(self.track, track)
        self.pose = put(self.pose, start(self.map.starts))
        self.samples = put(self.samples, start(self.start_samples))
        self.sampled = put(self.sampled, start(self.start_sampled))
        self.history, self.on_line = put(self.history, 0), put(self.on_line, False)
        self.steps, self.lap, self.clock = put(self.steps, 0), put(self.lap, 0), put(self.clock, -1)
        # Two on: by neither rule of the cone bonus has a car seen anything in the epoch before.
        self.epoch = self.epoch.index_add(0, cars, torch.full_like(track, 2, dtype=self.epoch.dtype))
        zero = torch.zeros_like(self.pose[0])
        observation, cones, count = (
            at.new_zeros(*at.shape[:-1], len(everyone)).index_copy_(-1, cars, start(at))
            for at in (self.start_observation, self.start_cones, self.start_count)
        )
        terms = dict.fromkeys(self.reward_terms, zero)
        return self._tensordict(observation.t(), cones, count, self._info(zero, zero.bool(), zero, zero, terms))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].detach().view(-1).clamp(-1, 1)
        if self.held_steps:
            action = action * (self.steps >= self.held_steps)
        roughness = (action - recent_mean(self.history)).abs_()
        self.history = torch.cat([action.unsqueeze(0), self.history[:-1]])
        self.pose = self._move(action)
        self.steps = self.steps + constant(1, self.steps)

        frame = Frame(self.pose)
        place = self.map.locate(self.track, frame.position)
        lap_time, finished = self._cross_the_line(place)
        seen, slot = self._look(place, self.pose, frame)
        discovered = self._discover(seen, slot, finished)
        observation, self.samples, self.sampled = self._observe(frame, seen, self.samples, self.sampled)
        to_boundaries = self.map.to_boundaries(place)
        clearance = self.map.clearance(place, to_boundaries)

        crashed = clearance <= constant(0, clearance)
        alive = (~crashed).to(action.dtype)
        terms = self._pay(Outcome(action, roughness, lap_time, finished, discovered, to_boundaries, crashed, alive))
        terminated = crashed | (self.lap >= constant(self.laps, self.lap))
        truncated = (self.steps >= constant(self.max_steps, self.steps)) & ~terminated
        return self._tensordict(
            observation,
            self._padded(seen.cones),
            seen.count.long(),
            {
                "reward": reduce(torch.add, terms.values()).to(action.dtype).unsqueeze(-1),
                "terminated": terminated.unsqueeze(-1),
                "truncated": truncated.unsqueeze(-1),
                "done": (terminated | truncated).unsqueeze(-1),
                **self._info(lap_time, crashed, clearance, roughness, terms),
            },
        )

    def _pay(self, outcome: Outcome) -> dict[str, Tensor]:
        """The terms of the reward, [B] each."""
        return pay(outcome, dict(zip(Reward._fields, self.weights.unbind(0), strict=True)))

    def _move(self, action: Tensor) -> Tensor:
        """The bicycle model (equations 99-100): first along the heading, then the heading turns."""
        heading = self.pose[2]
        turn = (action * constant(self.max_steering, action)).sin_()
        step = self.speed / self.rate
        strides = constant((step, step, step / self.car_length), self.pose)
        return torch.addcmul(self.pose, strides, torch.stack([heading.cos(), heading.sin(), turn]))

    def _cross_the_line(self, place: Place) -> tuple[Tensor, Tensor]:
        """Count laps; returns the lap time in s [B], 0 unless a lap was completed, and whether one was [B]."""
        square = (place.position - place.finish).square_().sum(0)
        inside = square < constant(FINISH_RADIUS**2, square)
        entered = inside & ~self.on_line
        finished = entered & (self.clock >= constant(0, self.clock))
        lap_time = (self.steps - self.clock) * finished / constant(self.rate, square)
        self.on_line = inside
        self.clock = torch.where(entered, self.steps, self.clock)
        self.lap = self.lap + finished
        return lap_time, finished

    def _look(self, place: Place, pose: Tensor, frame: Frame) -> tuple[View, Tensor]:
        slot, cones = self.map.candidates(place, pose[2])
        return view(frame.to_car(cones), self.kept_cones), slot

    def _discover(self, seen: View, slot: Tensor, finished: Tensor) -> Tensor:
        """On how many sides a cone came into sight [B]; keeps book of the cones that are not to be paid again.

        Each cone carries the epoch in which it was last seen. An epoch is a lap, or a step if sightings always pay.
        """
        before = self.epoch
        self.epoch = before + (1 if self.every_sighting else finished)
        known_since = before if self.every_sighting else self.epoch
        slot = slot.flatten().index_select(0, seen.index).view_as(seen.place)
        cars = len(self.epoch)
        index = torch.add(constant(range(cars), self.epoch, torch.int64), slot, alpha=cars).flatten()
        book = self.seen_in.view(-1)
        last = book.index_select(0, index).view_as(slot)
        new = seen.real * torch.ne(last, known_since)
        book.scatter_(0, index, torch.where(seen.real.bool(), self.epoch, last).flatten())
        return new.amax(0).sum(0)

    def _observe(self, frame: Frame, seen: View, samples: Tensor, sampled: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The observation [B, 20], from the boundaries in view or, where there is none, from the last one that was."""
        fresh = seen.real[1]
        local = boundary_samples(seen.cones, seen.count, self.fit)
        samples = torch.lerp(samples, frame.to_world(local), fresh)
        sampled = torch.maximum(sampled, fresh)
        return encode(torch.lerp(frame.to_car(samples), local, fresh), sampled), samples, sampled

    # Output

    def _padded(self, cones: Tensor) -> Tensor:
        missing = self.kept_cones - cones.shape[1]
        return cones if missing <= 0 else torch.cat([cones, cones.new_zeros(2, missing, *cones.shape[2:])], 1)

    def _info(
        self, lap_time: Tensor, crashed: Tensor, clearance: Tensor, smoothness: Tensor, terms: dict[str, Tensor]
    ) -> dict[str, TensorDict]:
        if not self.info:
            return {}
        columns = {
            "track": self.track, "lap": self.lap.long(), "lap_time": lap_time, "crashed": crashed,
            "clearance": clearance, "smoothness": smoothness,
        }  # fmt: skip
        paid = {key: value.to(self.dtype_).unsqueeze(-1) for key, value in terms.items()}
        entries: dict[str, Any] = {key: value.unsqueeze(-1) for key, value in columns.items()}
        entries |= {"pose": self.pose.t(), "reward": TensorDict(paid, self.batch_size, device=self.device)}
        return {"info": TensorDict(entries, self.batch_size, device=self.device)}

    def _tensordict(
        self, observation: Tensor, cones: Tensor, count: Tensor, others: Mapping[str, Tensor | TensorDict]
    ) -> TensorDict:
        return TensorDict(
            {
                "observation": observation,
                "cones": cones.permute(3, 2, 1, 0),
                "cone_count": count.t(),
                "steering": self.history[0].unsqueeze(-1),
                **others,
            },
            self.batch_size,
            device=self.device,
        )


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name}={value!r} must be one of {', '.join(choices)}")
