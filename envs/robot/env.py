"""Simulation of the paper's robot (section 4.2): a small car with a LiDAR between cones.

It drives at 0.15 m/s, takes one action per LiDAR scan, and perceives cones from its scans alone:
cones hide one another, are misclassified or missed. The entries have the keys and the scale of the
cone world, so guides and policies of that world run unchanged. The numbers come from data sheets,
not from a real robot.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from coil_rl.envs.meanings import of_cones
from coil_rl.envs.reward import LapsEnv
from coil_rl.envs.robot.course import RobotCourse, robot_track
from coil_rl.envs.robot.lidar import SimulatedLidar, cast_beams, move_along_arc
from coil_rl.envs.robot.perception import (
    BoundaryMemory,
    Perception,
    simulated_cone_classifier,
)
from coil_rl.envs.seeded_env import declare_specs
from coil_rl.envs.track import NEVER, Track
from coil_rl.ranges import Count, Degrees, Laps, Positive, Seconds, Starts, checked

FINISH_RADIUS = 0.15  # m, covers the width between the cones


@checked
class SimulatedRobotEnv(LapsEnv):
    """Simulated robots on tracks between cones, independent of one another.

    Reads `action` [B, 1], the steering angle as a fraction of `max_steering`. Writes the entries of
    `ConeTrackEnv`: `observation` [B, 20], `cones` [B, 2, K, 2] in the scale of the cone world,
    `cone_count` [B, 2], `steering` [B, 1], `reward`, `done`, `terminated`, `truncated` [B, 1], and
    under `info` the same entries in the robot's own metres, and `valid` [B, 2], whether each side
    is valid in this scan. The reward is that of the cone world without the term for new cones, as
    the robot cannot distinguish new cones from known ones. A robot crashes if its outline touches a
    cone or its centre reaches a boundary. All state is in buffers; `scan` [B, P] m is the last
    scan, infinite without a return.

    Args:
        tracks: in the robot's own metres, at least one; None for `robot_track()`.
        num_envs: B, the number of robots.
        starts: number of places where an episode may begin; place i is on track i mod len(tracks),
            and those of a track are spread along its middle. A lap that begins there counts as
            driven from the finish at full speed. None for the starts of the tracks.
        assignment: "random" draws a place at each reset; with `starts` it also draws at the first
            reset how much of `time_limit` is over, so that the episodes do not end together.
            "drawn" draws a place at each reset, and leaves each episode the whole limit. "cyclic"
            keeps robot i on place i mod places.
        perception: from scans to cones; None for `Perception` with the shipped classifier.
        lidar: the sensor, with one control step per scan; None for an RPLIDAR A1M8.
        spline: of the boundary estimate, "cubic" (smoothing) or "quadratic" (least-squares
            parabola).
        smoothing: lambda of the cubic smoothing spline, m^3 in the scale of the cone world.
        reward: weights by the names of `RewardWeights`; the others, or all with None, are those of
            the paper.
        laps: completed laps that end an episode.
        time_limit: s, after which an episode is truncated.
        speed: m/s, constant.
        car_length: m, distance between the axles; by default a seventh of the cone world's car.
        max_steering: degrees of an action of 1, at most 90.
        seed: of the LiDAR's noise and the draw of places.

    Raises:
        ValueError: for a value outside its range.

    Example:
        >>> from coil_rl.envs import SimulatedRobotEnv
        >>> env = SimulatedRobotEnv(num_envs=2)
        >>> env.rollout(3, break_when_any_done=False)["next", "observation"].shape
        torch.Size([2, 3, 20])
    """

    def __init__(
        self,
        tracks: Sequence[Track] | None = None,
        num_envs: Count = 1,
        *,
        starts: Starts | None = None,
        assignment: Literal["random", "drawn", "cyclic"] = "random",
        perception: Perception | None = None,
        lidar: SimulatedLidar | None = None,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        reward: dict[str, float] | None = None,
        laps: Laps = 3,
        time_limit: Seconds = 200.0,
        speed: Positive = 0.15,
        car_length: Positive = 2 / 7,
        max_steering: Degrees = 80.0,
        seed: int = 0,
    ) -> None:
        if tracks is not None and not tracks:
            raise ValueError("tracks is empty; give at least one, or None for robot_track()")
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.tracks = [robot_track()] if tracks is None else list(tracks)
        self.assignment = assignment
        self.perception = perception or Perception(simulated_cone_classifier())
        self.lidar = lidar or SimulatedLidar()
        self.rate = self.lidar.rate
        self.laps, self.max_steps = laps, round(time_limit * self.rate)
        self.speed, self.car_length = speed, car_length
        self.step_length = speed / self.rate
        self.max_steering = math.radians(max_steering)
        self.memory = BoundaryMemory(num_envs, spline, smoothing, sight=self.perception.sight)
        self.generator, self.everyone = torch.Generator(), torch.arange(num_envs)
        self.course = RobotCourse(self.tracks)
        finish = np.stack([track.finish for track in self.tracks], axis=1)
        self.finish = torch.tensor(finish).float()
        self.staggered = starts is not None
        self.start_track, self.start_pose, self.start_lap_start = self._places(self.tracks, starts)
        inside = self._inside(self.start_pose, self.start_track)
        self.start_in_finish = inside & (self.start_lap_start > NEVER)
        self._register_laps(reward)
        self.scan: Tensor = nn.Buffer(torch.full((num_envs, self.lidar.beams), torch.inf))
        # The cones that were perceived in it, and their number.
        kept = self.perception.kept_cones
        self.cones: Tensor = nn.Buffer(torch.zeros(num_envs, 2, kept, 2))
        self.count: Tensor = nn.Buffer(torch.zeros(num_envs, 2, dtype=torch.int64))
        declare_specs(self, self._reset())
        self.set_seed(seed)

    @property
    def meanings(self) -> dict[str, dict[str, str]]:
        """What the entries mean, see `coil_rl.envs.meanings`."""
        max_steering = math.degrees(self.max_steering)
        return of_cones(self.perception.sight, max_steering, self.perception.scale)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # All robots draw and measure, reset or not: the order of random numbers must not depend on
        # the data.
        rows, _ = self._begin(tensordict)
        mask = torch.zeros(self.batch_size, dtype=torch.bool).index_fill(0, rows, True)
        standing = self.pose.unsqueeze(-1).expand(-1, -1, self.lidar.beams)
        self.scan = torch.where(mask.unsqueeze(-1), self._measure(standing, rows), self.scan)
        self.memory.reset(mask)
        # Robots that are not reset see what they saw, which does not change their memory.
        return self._first(self._perceive(rows))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"].detach().view(-1).clamp(-1, 1)
        roughness = self._act(action)
        self._move(action)
        view = self._perceive(self.everyone)
        lap_time, finished = self._count_laps(self._inside(self.pose, self.track))
        clearance, to_boundaries = self.course.clearance(self.track, self.pose)
        return self._judged(
            view,
            clearance,
            action=action,
            roughness=roughness,
            lap_time=lap_time,
            finished=finished,
            discovered=torch.zeros_like(action),
            to_boundaries=to_boundaries,
        )

    def _move(self, action: Tensor) -> None:
        """Move along an arc by the bicycle model (equations 99-100), and scan on the way."""
        turn = (action * self.max_steering).sin() * (self.step_length / self.car_length)
        phase = self.lidar.phase
        poses = move_along_arc(
            self.pose.unsqueeze(-1), self.step_length * phase, turn.unsqueeze(-1) * phase
        )
        self.pose = move_along_arc(self.pose, torch.full_like(turn, self.step_length), turn)
        self.scan = self._measure(poses, self.everyone)

    def _measure(self, poses: Tensor, rows: Tensor) -> Tensor:
        """Return a scan [B, P] m, measured at a pose for each beam.

        Args:
            poses: [3, B, P].
            rows: indices of the robots whose scan is needed. Noise is drawn for all.
        """
        track = self.track[rows]
        cones, radius = self.course.cones[:, track], self.course.radius[track]
        distance, _ = cast_beams(poses[:, rows], self.lidar.angles, cones, radius)
        true = torch.full_like(self.scan, torch.inf).index_copy(0, rows, distance)
        return self.lidar.measure(true, self.generator, self.different)[0]

    def stand(self) -> None:
        """Measure another scan while all robots stand, which is no step of their episodes."""
        standing = self.pose.unsqueeze(-1).expand(-1, -1, self.lidar.beams)
        self.scan = self._measure(standing, self.everyone)

    def _perceive(self, rows: Tensor) -> dict[str, Tensor]:
        """Update the memory with the last scan; return the entries that come from it.

        Args:
            rows: indices of the robots whose scan is a new one.
        """
        found, number = self.perception(self.scan[rows].numpy(), self.lidar.angles.numpy())
        self.cones = self.cones.index_copy(0, rows, torch.from_numpy(found).float())
        self.count = self.count.index_copy(0, rows, torch.from_numpy(number))
        observation, self.valid = self.memory(self.cones, self.count)
        return {"observation": observation, "cones": self.cones, "cone_count": self.count}

    def _inside(self, pose: Tensor, track: Tensor) -> Tensor:
        """Return whether poses [3, N] on tracks [N] are in the finish circle, [N]."""
        return (pose[:2] - self.finish[:, track]).norm(dim=0) < FINISH_RADIUS

    def _output(self, *parts: Any, **ends: Any) -> TensorDict:
        out = super()._output(*parts, **ends)
        out["info", "valid"] = self.valid
        return out
