"""The cone world of the paper (section 4.1) as a batched TorchRL env.

Each car drives on a closed track between two rings of cones at constant speed and chooses its
steering. It observes the cones ahead. The reward pays for laps, newly visible cones and each step,
and charges for rough steering and crashes.

This file holds the state of the cars and puts a step together: move, count laps, look for cones,
estimate the boundaries, judge. Each of these parts is in a file of its own. A step consists of the
same tensor operations for all cars, whatever happens to them, and does not wait for the device.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from coil_rl.envs.boundaries import Boundaries
from coil_rl.envs.constants import constant
from coil_rl.envs.meanings import of_cones
from coil_rl.envs.reward import LapsEnv
from coil_rl.envs.seeded_env import declare_specs
from coil_rl.envs.sight import HALF_FIELD_OF_VIEW, SAMPLES, SIGHT, Frame, View, view
from coil_rl.envs.splines import spline_fit
from coil_rl.envs.track import NEVER, Track, begin_in_sight
from coil_rl.envs.track_map import Location, TrackMap
from coil_rl.ranges import (
    Count,
    Degrees,
    Interval,
    Laps,
    Positive,
    Seconds,
    Seed,
    SeenCones,
    Starts,
    checked,
)

FINISH_RADIUS = 0.625  # m


@checked
class ConeTrackEnv(LapsEnv):
    """Cars on tracks between cones.

    Reads `action` [B, 1], the steering angle as a fraction of `max_steering`. It writes:

    | entry | shape | meaning |
    | --- | --- | --- |
    | `observation` | [B, 20] | the boundaries ahead, see `encode_samples` |
    | `cones` | [B, 2, K, 2] | m, car frame (x ahead, y left), left side first, nearest first |
    | `cone_count` | [B, 2] | number of real cones among the K |
    | `steering` | [B, 1] | the action in force |
    | `motion` | [B, 3] | way since the last observation: m ahead, m to the left, radians |
    | `reward`, `done`, `terminated`, `truncated` | [B, 1] | as in every env |

    For evaluation only, it writes under `info`: `track` (index), `lap` (completed laps), `lap_time`
    (s, of the lap just completed, else 0), `crashed`, `completed`, `clearance` (m, to a crash),
    `smoothness` (|a - mean of the last 20 actions|), each [B, 1], `pose` [B, 3] (m, m, radians) and
    `reward`, with one entry [B, 1] per term.

    Args:
        tracks: the tracks, at least one; cars refer to them by index.
        num_envs: B, the number of cars, which are independent of each other.
        rate: control steps per second.
        spline: of the boundary estimate, "cubic" (smoothing) or "quadratic" (least-squares
            parabola).
        smoothing: lambda of the cubic smoothing spline, m^3.
        cone_bonus: "first_sighting" rewards a cone once a lap, "every_sighting" whenever it comes
            into sight.
        reward: weights by the names of `RewardWeights`; the others, or all with None, are those of
            the paper.
        laps: completed laps that end an episode.
        time_limit: s, after which an episode is truncated; at least one step.
        held_steps: number of steps at the start of an episode with steering 0.
        starts: number of places where an episode may begin; place i is on track i mod len(tracks),
            and those of a track are spread along its middle. A lap that begins there counts as
            driven from the finish at full speed. None for the starts of the tracks.
        assignment: "random" draws a place at each reset; with `starts` it also draws at the first
            reset how much of `time_limit` is over, so that the episodes do not end together.
            "drawn" draws a place at each reset, and leaves each episode the whole limit. "cyclic"
            keeps car i on place i mod places.
        sight: m, range of view.
        hold_boundary: whether the boundary estimate stays in place until a cone comes into view. It
            is then made without cones that share their x or y with a nearer one; a side with fewer
            than two lies at the origin.
        finish_in_sight: whether the finish line is between the first cones of the level file that
            are visible from the track's start, in place of the first ones.
        kept_cones: K, the nearest visible cones of each side that are written.
        speed: m/s, constant.
        car_length: m, distance between the axles.
        max_steering: degrees of an action of 1, at most 90.
        info: whether to write `info`, which takes time.
        seed: of the draw of places, at least 0.
        device: of all tensors.
        dtype: of all floating-point tensors.

    Raises:
        ValueError: for a value outside its range.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_envs=8)
        >>> env.rollout(3, break_when_any_done=False)["next", "observation"].shape
        torch.Size([8, 3, 20])
    """

    begun: ClassVar[tuple[str, ...]] = (*LapsEnv.begun, "samples", "sampled")

    def __init__(
        self,
        tracks: Sequence[Track],
        num_envs: Count = 64,
        *,
        rate: Annotated[float, Interval(gt=0, le=1000)] = 24.0,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        cone_bonus: Literal["first_sighting", "every_sighting"] = "first_sighting",
        reward: dict[str, float] | None = None,
        laps: Laps = 2,
        time_limit: Seconds = 200.0,
        held_steps: Annotated[int, Interval(ge=0, le=10**6)] = 0,
        starts: Starts | None = None,
        assignment: Literal["random", "drawn", "cyclic"] = "random",
        sight: Annotated[float, Interval(gt=0, le=100)] = SIGHT,
        hold_boundary: bool = False,
        finish_in_sight: bool = False,
        kept_cones: SeenCones = 16,
        speed: Positive = 2.0,
        car_length: Positive = 2.0,
        max_steering: Degrees = 80.0,
        info: bool = True,
        seed: Seed = 0,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if round(time_limit * rate) < 1:
            raise ValueError(f"time_limit={time_limit} must be at least one step of 1/{rate} s")
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        self.dtype_, self.generator = dtype, torch.Generator()
        self.rate, self.laps, self.held_steps = rate, laps, held_steps
        self.assignment, self.info = assignment, info
        self.max_steps = round(time_limit * rate)
        self.every_sighting = cone_bonus == "every_sighting"
        self.kept_cones, self.speed, self.car_length = kept_cones, speed, car_length
        self.max_steering = math.radians(max_steering)
        self.spline, self.smoothing, self.sight = spline, smoothing, sight
        self.boundaries = Boundaries(spline_fit(spline, smoothing), sight, hold=hold_boundary)
        if finish_in_sight:
            tracks = [begin_in_sight(track, sight, HALF_FIELD_OF_VIEW) for track in tracks]
        self.map = TrackMap(tracks, sight=sight, dtype=dtype).to(self.device)
        self._register_state(reward)
        self.compiled: Callable[..., Sequence[Tensor]] | None = None
        self.tables = [self.weights, *self.map.buffers()]
        self.staggered = starts is not None
        self._register_starts(starts)
        declare_specs(self, ConeTrackEnv._reset(self))
        self.set_seed(seed)

    @property
    def meanings(self) -> dict[str, dict[str, str]]:
        """What the entries mean, see `coil_rl.envs.meanings`."""
        return of_cones(self.sight, math.degrees(self.max_steering))

    def _register_state(self, reward: Mapping[str, float] | None) -> None:
        """Register all state as buffers; their last dimension is the cars."""
        self._register_laps(reward)
        # Number of steps over all episodes, and of resets; a clock that never goes back.
        self.epoch: Tensor = self._zeros(dtype=torch.int32)
        self.lap_epoch: Tensor = self._zeros(dtype=torch.int32)  # epoch in which the lap began
        # Epoch of each cone's last sighting.
        self.last_seen: Tensor = self._zeros(2 * self.map.slots, dtype=torch.int32)
        # m, last boundary estimate, in world coordinates.
        self.samples: Tensor = self._zeros(2, SAMPLES, 2)
        self.sampled: Tensor = self._zeros(2)  # 1 for a side with an estimate
        buffers = self.named_buffers(recurse=False)
        self.state_names = [name for name, _ in buffers if name != "weights"]

    def _register_starts(self, starts: int | None) -> None:
        """Observe all P places where an episode may begin once, so that a reset only copies."""
        tracks, pose, lap_start = self._places(self.map.tracks, starts)
        frame = Frame(pose)
        location = self.map.locate(tracks, frame.position)
        visible, _, cones = self._view(location, pose, frame)
        samples = torch.zeros(2, SAMPLES, 2, len(tracks), dtype=self.dtype_, device=self.device)
        new, sampled = torch.ones_like(lap_start, dtype=torch.bool), torch.zeros_like(samples[0, 0])
        observation, samples, sampled = self.boundaries.observe(
            frame, visible, cones, new, samples, sampled
        )
        buffers = {
            "observation": observation.t(),
            "cones": visible.cones,
            "count": visible.count.long(),
            "track": tracks,
            "pose": pose,
            "lap_start": lap_start,
            "samples": samples,
            "sampled": sampled,
            "in_finish": _in_finish(location) & (lap_start > NEVER),
        }
        for name, value in buffers.items():
            self.register_buffer(f"start_{name}", value, persistent=False)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        cars, start = self._begin(tensordict)
        # Under either rule of the cone bonus, no cone was seen in the epoch before the new one.
        self.epoch = self.epoch.index_add(0, cars, torch.full_like(cars, 2, dtype=self.epoch.dtype))
        self.lap_epoch = self.lap_epoch.index_copy(0, cars, self.epoch.index_select(0, cars))
        observation, cones, count = (
            at.new_zeros(*at.shape[:-1], len(self.steps)).index_copy_(-1, cars, start(at))
            for at in (self.start_observation, self.start_cones, self.start_count)
        )
        motion = torch.zeros_like(self.pose)
        return self._first(self._observed(observation.t(), cones, count, motion))

    def compile_steps(
        self, compiled: Callable[[Callable[..., list[Tensor]]], Callable[..., Sequence[Tensor]]]
    ) -> None:
        """Compile the steps; the last digits of the numbers change.

        Args:
            compiled: compiles a function from tensors to tensors.
        """
        self.compiled = compiled(self._step_on_tensors)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].detach().view(-1).clamp(-1, 1)
        if self.compiled is None:
            return self._advance(action)
        state = [getattr(self, name) for name in self.state_names]
        values = self.compiled(action, *state, *self.tables)
        count = len(self.entries)
        for name, value in zip(self.changed, values[count:], strict=True):
            setattr(self, name, value)
        entries = dict(zip(self.entries, values[:count], strict=True))
        return TensorDict(entries, self.batch_size, device=self.device)

    def _step_on_tensors(self, action: Tensor, *tensors: Tensor) -> list[Tensor]:
        """Return the entries after a step and the state that it replaces, for compilation."""
        before = {name: getattr(self, name) for name in self.state_names}
        output = self._advance(action)
        after = {name: getattr(self, name) for name in self.state_names}
        for name, value in before.items():
            setattr(self, name, value)
        self.entries = list(output.keys(True, True))
        self.changed = [name for name, value in after.items() if value is not before[name]]
        return [*(output[key] for key in self.entries), *(after[name] for name in self.changed)]

    def _advance(self, action: Tensor) -> TensorDict:
        """Drive one step with actions [B], and return the entries after it."""
        if self.held_steps:
            action = action * (self.steps >= self.held_steps)
        roughness = self._act(action)
        self.pose, motion = self._move(action)
        frame = Frame(self.pose)
        location = self.map.locate(self.track, frame.position)
        lap_time, finished = self._count_laps(_in_finish(location))
        visible, slots, cones = self._view(location, self.pose, frame)
        discovered, new = self._count_new_cones(visible, slots, finished)
        observed = self.boundaries.observe(frame, visible, cones, new, self.samples, self.sampled)
        observation, self.samples, self.sampled = observed
        to_boundaries = self.map.to_boundaries(location)
        return self._judged(
            self._observed(observation, visible.cones, visible.count.long(), motion),
            self.map.clearance(location, to_boundaries),
            action=action,
            roughness=roughness,
            lap_time=lap_time,
            finished=finished,
            discovered=discovered,
            to_boundaries=to_boundaries,
        )

    def _move(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """Return pose and motion after a step of the bicycle model (equations 99-100).

        A car moves along its heading and then turns. Both results are [3, B]: the new pose in m, m
        and radians, and the way there in m ahead, m to the left and radians.
        """
        heading = self.pose[2]
        turn = (action * constant(self.max_steering, action)).sin_()
        step = self.speed / self.rate
        strides = constant((step, step, step / self.car_length), self.pose)
        pose = torch.addcmul(self.pose, strides, torch.stack([heading.cos(), heading.sin(), turn]))
        forward = constant((step, 0.0), pose).expand(2, len(turn))
        return pose, torch.cat([forward, (turn * strides[2]).unsqueeze(0)])

    def _view(self, location: Location, pose: Tensor, frame: Frame) -> tuple[View, Tensor, Tensor]:
        """Return the visible cones, and the slots and positions of all candidates."""
        slots, cones = self.map.candidates(location, pose[2])
        return view(frame.to_car(cones), self.kept_cones, self.sight), slots, cones

    def _count_new_cones(
        self, visible: View, slots: Tensor, finished: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Note the visible cones, and find those that count as new.

        Args:
            visible: the cones in sight.
            slots: slots of all candidates, [N, 2, B].
            finished: [B], whether a new lap began, in which all cones are new.

        Returns:
            The number of sides with a rewarded cone, and whether any cone came into view, [B] each.
        """
        before = self.epoch
        self.epoch = before + constant(1, before)
        self.lap_epoch = torch.where(finished, self.epoch, self.lap_epoch)
        slots = slots.flatten().index_select(0, visible.index).view_as(visible.candidate)
        cars = len(self.epoch)
        columns = constant(range(cars), self.epoch, torch.int64)
        index = torch.add(columns, slots, alpha=cars).flatten()
        last_seen = self.last_seen.view(-1)
        last = last_seen.index_select(0, index).view_as(slots)
        rewarded = visible.real * torch.lt(last, before if self.every_sighting else self.lap_epoch)
        entered = visible.real * torch.lt(last, before) if self.boundaries.hold else rewarded
        last_seen.scatter_(0, index, torch.where(visible.real.bool(), self.epoch, last).flatten())
        return rewarded.amax(0).sum(0), entered.flatten(0, 1).amax(0).bool()

    def _observed(
        self, observation: Tensor, cones: Tensor, count: Tensor, motion: Tensor
    ) -> dict[str, Tensor]:
        """Return what the cars observe, with the batch first.

        Args:
            observation: [B, 20].
            cones: [2, at most K, 2, B] m.
            count: [2, B].
            motion: [3, B], m ahead, m to the left, radians.
        """
        missing = self.kept_cones - cones.shape[1]
        if missing > 0:
            cones = torch.cat([cones, cones.new_zeros(2, missing, *cones.shape[2:])], 1)
        return {
            "observation": observation,
            "cones": cones.permute(3, 2, 1, 0),
            "cone_count": count.t(),
            "motion": motion.t(),
        }


def _in_finish(location: Location) -> Tensor:
    """Return whether each car is in the finish circle of its track, [B]."""
    square = (location.position - location.finish).square_().sum(0)
    return square < constant(FINISH_RADIUS**2, square)
