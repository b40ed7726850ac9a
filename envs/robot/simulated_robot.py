"""The robot of the paper (section 4.2), simulated: a small car with a LiDAR between thin and thick cones.

It drives on a physical track at 0.15 m/s, is steered once a turn of its LiDAR, and knows the world by its scans alone:
cones hide one another, are taken for the other kind, or are not seen. What it writes has the keys and the scale of
the cone world, so that any guide or policy of that world drives it unchanged. No real robot was measured for this.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded

from coil_rl.envs.cone_track import SeededEnv
from coil_rl.envs.reward import (
    HISTORY,
    REWARD_TERMS,
    Outcome,
    RewardWeights,
    check_weights,
    recent_mean,
    weighted_terms,
)
from coil_rl.envs.robot.boundary_memory import BoundaryMemory
from coil_rl.envs.robot.cone_classifier import simulated_cone_classifier
from coil_rl.envs.robot.course import RobotCourse, robot_track
from coil_rl.envs.robot.lidar import SimulatedLidar, driven
from coil_rl.envs.robot.perception import Perception
from coil_rl.envs.sight import SAMPLES
from coil_rl.envs.track import Track

FINISH_RADIUS = 0.15  # m, so wide that nobody between the cones drives past it


class SimulatedRobotEnv(SeededEnv):
    """Simulated robots on tracks between cones, each by itself.

    Reads `action` [B, 1], the steering angle as a fraction of 80 degrees. Writes what `ConeTrackEnv` does:
    `observation` [B, 20], `cones` [B, 2, K, 2] in the scale of the simulation, `cone_count` [B, 2], `steering` [B, 1],
    `reward`, `done`, `terminated`, `truncated` [B, 1], and under `info` the same entries in the robot's own metres, and
    `valid` [B, 2], whether each side was seen in this scan. The reward is that of the cone world without the term
    for cones: the robot cannot tell a new one from one that comes back. A robot crashes where its outline
    touches a cone or its middle comes to the line between two. All state is in buffers; `scan` [B, P] m is the last
    scan, infinite where nothing came back.

    Args:
        tracks: where to drive, in the robot's own metres; None for `robot_track()`.
        num_cars: B.
        assignment: "random" draws a track at each reset, "cyclic" keeps robot i on track i mod len(tracks).
        perception: from scans to cones; None for one with the classifier that learned from simulated scans.
        lidar: None for an RPLIDAR A1M8; its turns a second are the control steps.
        spline: of the boundary estimate, "cubic" (smoothing) or "quadratic" (interpolating).
        smoothing: lambda of the cubic smoothing spline, m^3.
        reward: weights, see `RewardWeights`.
        laps: completed laps that end an episode.
        time_limit: s, then an episode is truncated.
        speed: m/s.
        car_length: L in m; by default that of the simulated car at a seventh of its size.
        max_steering: degrees of an action of 1.
        seed: of the LiDAR's noise, and of the draw of tracks.

    Raises:
        ValueError: for a value outside its range, naming it.

    Example:
        >>> from coil_rl.envs import SimulatedRobotEnv
        >>> env = SimulatedRobotEnv(num_cars=2)
        >>> env.rollout(3, break_when_any_done=False)["next", "observation"].shape
        torch.Size([2, 3, 20])
    """

    track: Tensor
    pose: Tensor
    history: Tensor
    steps: Tensor
    lap: Tensor
    clock: Tensor
    on_line: Tensor
    scan: Tensor

    def __init__(
        self,
        tracks: Sequence[Track] | None = None,
        num_cars: int = 1,
        *,
        assignment: Literal["random", "cyclic"] = "random",
        perception: Perception | None = None,
        lidar: SimulatedLidar | None = None,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        reward: dict[str, float] | None = None,
        laps: int = 3,
        time_limit: float = 200.0,
        speed: float = 0.15,
        car_length: float = 2 / 7,
        max_steering: float = 80.0,
        seed: int = 0,
    ) -> None:
        positive = {
            "num_cars": num_cars, "laps": laps, "time_limit": time_limit, "speed": speed, "car_length": car_length,
            "max_steering": max_steering,
        }  # fmt: skip
        for name, given in positive.items():
            if not 0 < given < math.inf:
                raise ValueError(f"{name}={given} must be a finite number above 0")
        if max_steering > 90:
            raise ValueError(f"max_steering={max_steering} must be at most 90 degrees")
        if assignment not in ("random", "cyclic"):
            raise ValueError(f"assignment={assignment!r} must be one of random, cyclic")
        if tracks is not None and not tracks:
            raise ValueError("tracks is empty; give at least one, or None for robot_track()")
        check_weights("reward", reward or {}, RewardWeights._fields)
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_cars]))
        self.tracks = [robot_track()] if tracks is None else list(tracks)
        self.assignment = assignment
        self.perception = perception or Perception(simulated_cone_classifier())
        self.lidar = lidar or SimulatedLidar()
        self.laps, self.max_steps = laps, round(time_limit * self.lidar.rate)
        self.step_length, self.car_length = speed / self.lidar.rate, car_length
        self.max_steering = math.radians(max_steering)
        self.weights = {key: torch.tensor(float(x)) for key, x in RewardWeights(**(reward or {}))._asdict().items()}
        self.memory = BoundaryMemory(
            num_cars, spline, smoothing, sight=self.perception.range_max * self.perception.scale
        )
        self.generator = torch.Generator()
        self.course = RobotCourse(self.tracks)
        self.starts = torch.tensor([track.start for track in self.tracks]).t()
        self.finish = torch.tensor(np.stack([track.finish for track in self.tracks], axis=1)).float()
        self._declare_specs()
        for name, value in {
            "track": torch.arange(num_cars) % len(self.tracks), "pose": torch.zeros(3, num_cars),
            "history": torch.zeros(HISTORY, num_cars),
            "steps": torch.zeros(num_cars, dtype=torch.int64), "lap": torch.zeros(num_cars, dtype=torch.int64),
            "clock": torch.full((num_cars,), -1), "on_line": torch.zeros(num_cars, dtype=torch.bool),
            "scan": torch.full((num_cars, self.lidar.beams), torch.inf),
        }.items():  # fmt: skip
            self.register_buffer(name, value)
        self.set_seed(seed)

    def _declare_specs(self) -> None:
        robots = self.batch_size

        def real(*shape: int) -> Unbounded:
            return Unbounded((*robots, *shape), dtype=torch.float32)

        def whole(*shape: int) -> Unbounded:
            return Unbounded((*robots, *shape), dtype=torch.int64)

        def flags(count: int) -> Binary:
            return Binary(count, shape=(*robots, count), dtype=torch.bool)

        info = Composite(
            track=whole(1), lap=whole(1), lap_time=real(1), crashed=flags(1), clearance=real(1), smoothness=real(1),
            pose=real(3), valid=flags(2), reward=Composite({term: real(1) for term in REWARD_TERMS}, shape=robots),
            shape=robots,
        )  # fmt: skip
        self.observation_spec = Composite(
            observation=Bounded(-1, 1, (*robots, 4 * SAMPLES)), cones=real(2, self.perception.kept_cones, 2),
            cone_count=whole(2), steering=Bounded(-1, 1, (*robots, 1)), info=info, shape=robots,
        )  # fmt: skip
        self.action_spec = Bounded(-1, 1, (*robots, 1))
        self.reward_spec = real(1)
        self.done_spec = Composite({key: flags(1) for key in ("done", "terminated", "truncated")}, shape=robots)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        given = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones(self.batch_size, dtype=torch.bool) if given is None else given.view(-1)
        if self.assignment == "random":
            # All robots draw and measure, reset or not: which numbers come next must not depend on the data.
            drawn = torch.randint(len(self.tracks), self.batch_size, generator=self.generator)
            self.track = torch.where(mask, drawn, self.track)
        self.pose = torch.where(mask, self.starts[:, self.track], self.pose)
        for name, value in {"history": 0, "steps": 0, "lap": 0, "clock": -1, "on_line": False}.items():
            setattr(self, name, getattr(self, name).masked_fill(mask, value))
        standing = self.pose.unsqueeze(-1).expand(-1, -1, self.lidar.beams)
        self.scan = torch.where(mask.unsqueeze(-1), self._measure(standing), self.scan)
        self.memory.reset(mask)
        # To see the same scan twice changes nothing for the others.
        seen = self._see()
        zero = torch.zeros(self.batch_size)
        return self._tensordict(seen, zero, zero.bool(), zero, zero, dict.fromkeys(REWARD_TERMS, zero))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].detach().view(-1).clamp(-1, 1)
        roughness = (action - recent_mean(self.history)).abs()
        self.history = torch.cat([action.unsqueeze(0), self.history[:-1]])
        self.steps = self.steps + 1
        turn = (action * self.max_steering).sin() * (self.step_length / self.car_length)
        phase = self.lidar.phase
        on_the_way = driven(self.pose.unsqueeze(-1), self.step_length * phase, turn.unsqueeze(-1) * phase)
        self.pose = driven(self.pose, torch.full_like(turn, self.step_length), turn)
        self.scan = self._measure(on_the_way)
        seen = self._see()

        lap_time, finished = self._cross_the_line()
        clearance, to_boundaries = self.course.clearance(self.track, self.pose)
        crashed = clearance <= 0
        nothing, alive = torch.zeros_like(action), (~crashed).float()
        outcome = Outcome(action, roughness, lap_time, finished, nothing, to_boundaries, crashed, alive)
        terms = weighted_terms(outcome, self.weights)
        terminated = crashed | (self.lap >= self.laps)
        truncated = (self.steps >= self.max_steps) & ~terminated
        out = self._tensordict(seen, lap_time, crashed, clearance, roughness, terms)
        out["reward"] = reduce(torch.add, terms.values()).unsqueeze(-1)
        out["terminated"], out["truncated"] = terminated.unsqueeze(-1), truncated.unsqueeze(-1)
        out["done"] = (terminated | truncated).unsqueeze(-1)
        return out

    def _measure(self, poses: Tensor) -> Tensor:
        true, _ = self.lidar.cast(poses, self.course.cones[:, self.track], self.course.radius[self.track])
        return self.lidar.measure(true, self.generator)[0]

    def _see(self) -> dict[str, Tensor]:
        """What the last scan shows, and what is remembered from before."""
        cones, count = (torch.from_numpy(x) for x in self.perception(self.scan.numpy(), self.lidar.angles.numpy()))
        cones = cones.float()
        observation, valid = self.memory(cones, count)
        return {"observation": observation, "cones": cones, "cone_count": count, "valid": valid}

    def _cross_the_line(self) -> tuple[Tensor, Tensor]:
        """Count laps; returns the lap time in s [B], 0 unless a lap was completed, and whether one was [B]."""
        inside = (self.pose[:2] - self.finish[:, self.track]).norm(dim=0) < FINISH_RADIUS
        entered = inside & ~self.on_line
        finished = entered & (self.clock >= 0)
        lap_time = (self.steps - self.clock) * finished / self.lidar.rate
        self.on_line, self.lap = inside, self.lap + finished
        self.clock = torch.where(entered, self.steps, self.clock)
        return lap_time, finished

    def _tensordict(
        self,
        seen: dict[str, Tensor],
        lap_time: Tensor,
        crashed: Tensor,
        clearance: Tensor,
        smoothness: Tensor,
        terms: dict[str, Tensor],
    ) -> TensorDict:
        columns = {
            "track": self.track, "lap": self.lap, "lap_time": lap_time, "crashed": crashed,
            "clearance": clearance, "smoothness": smoothness,
        }  # fmt: skip
        paid = {key: value.unsqueeze(-1) for key, value in terms.items()}
        info: dict[str, Any] = {key: value.unsqueeze(-1) for key, value in columns.items()}
        info |= {"pose": self.pose.t(), "valid": seen["valid"], "reward": TensorDict(paid, self.batch_size)}
        entries: dict[str, Any] = {key: seen[key] for key in ("observation", "cones", "cone_count")}
        entries |= {"steering": self.history[0].unsqueeze(-1), "info": TensorDict(info, self.batch_size)}
        return TensorDict(entries, self.batch_size, device=self.device)
