"""Drives of simulated robots: scripted drives with the true cone of each range, and recordings of drives as MCAP.

In a recording, a scan is stamped with the time of its first measurement and logged at the time of
its last one. As with rplidar_ros, the first measurement is the last range of the message (see
`SimulatedLidar`). A command follows each scan and takes effect during the next one. The odometry
has the pose at the start of each scan and at the end. The metadata record `track` has the cones and
the start, in the odometry's frame.
"""

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, TransformedEnv, set_exploration_type, step_mdp

from coil_rl.envs.limits import check_choice
from coil_rl.envs.recordings.mcap_files import RecordingWriter
from coil_rl.envs.recordings.messages import ODOMETRY, SCAN, TWIST, header, twist
from coil_rl.envs.recordings.reading import SIMULATED, Recording, RecordingError
from coil_rl.envs.robot.course import (
    THICK,
    THIN,
    cones_of,
    middle_line,
    noted_track,
    robot_track,
    track_notes,
)
from coil_rl.envs.robot.env import SimulatedRobotEnv
from coil_rl.envs.robot.lidar import RANGE_MAX, RANGE_MIN, SimulatedLidar, cast_beams
from coil_rl.envs.track import Track, TrackError

Path = str | os.PathLike[str]
Sides = Literal["left", "right", "both"]

SPEED = 0.15  # m/s
SWAY = 0.04  # m, greatest distance to the centre line
TEST_SEED = 100  # first seed of the test drives; training drives have smaller ones
MAX_RANGE_ERROR = 0.03  # m, a range with a greater error is an outlier


@dataclass(frozen=True, eq=False)
class SimulatedDrive:
    """T scans of a drive with their ground truth."""

    name: str
    track: Track
    sides: Sides  # of the track with cones
    seconds: Tensor  # [T] start of each scan
    angles: Tensor  # [P] radians, bearings of the beams, or [T, P] if each scan has its own
    ranges: Tensor  # [T, P] m, infinite without a return
    hit: Tensor  # [T, P] index of the cone of each range, -1 for none
    poses: Tensor  # [3, T, P] sensor pose at the time of each beam (m, m, radians), NaN for padding
    cones: Tensor  # [2, M] m, centres
    radius: Tensor  # [M] m, of the cones
    # [T, M] share of a cone's beams that no nearer cone blocks; 0 for a cone without beams
    visibility: Tensor

    @property
    def thick(self) -> Tensor:
        """Whether each cone is thick, [M]."""
        return self.radius > (THIN + THICK) / 2


def simulated_drive(sides: Sides, seed: int, lidar: SimulatedLidar | None = None) -> SimulatedDrive:
    """Simulate a lap along the centre line of `robot_track()` with cones on one side or both.

    The seed is that of the noise and the sway. By default the LiDAR is an RPLIDAR A1M8.
    """
    check_choice(("left", "right", "both"), sides=sides)
    track, lidar = robot_track(), lidar or SimulatedLidar()
    generator = torch.Generator().manual_seed(seed)
    line = torch.from_numpy(middle_line(track, SPEED / lidar.rate))
    waves, phase = torch.rand(2, generator=generator, dtype=torch.float64)
    # The closed line, displaced sideways by a sine.
    along = line.roll(-1, 0) - line.roll(1, 0)
    across = torch.stack([-along[:, 1], along[:, 0]], 1) / along.norm(dim=1, keepdim=True)
    periods = torch.linspace(0, 3 + 5 * float(waves), len(line), dtype=line.dtype) + float(phase)
    path = line + SWAY * (2 * torch.pi * periods).sin().unsqueeze(1) * across
    # One scan for each step of the path: poses at the time of each beam.
    way = path[1:] - path[:-1]
    heading = torch.atan2(way[:, 1], way[:, 0])
    turn = torch.remainder(heading[1:] - heading[:-1] + torch.pi, 2 * torch.pi) - torch.pi
    position = path[:-2, :, None] + way[:-1, :, None] * lidar.phase
    bearing = (heading[:-1, None] + turn[:, None] * lidar.phase).unsqueeze(1)
    poses = torch.cat([position, bearing], 1).transpose(0, 1).float()
    cones, radius = cones_of(track, left=sides != "right", right=sides != "left")
    true, hit = cast_beams(poses, lidar.angles, cones, radius)
    ranges, outlier = lidar.measure(true, generator)
    seconds = torch.arange(len(ranges), dtype=torch.float64) / lidar.rate
    visibility = _visibility(poses, lidar.angles, cones, radius, hit)
    hit = torch.where(outlier, -1, hit)
    name = f"{sides}_{seed}"
    return SimulatedDrive(
        name, track, sides, seconds, lidar.angles, ranges, hit, poses, cones, radius, visibility
    )


def labelled_drive(recording: Recording) -> SimulatedDrive:
    """Return a recorded drive, simulated or real, with the ground truth that follows from its odometry and track.

    The last scan is left out, as the pose at its end is unknown. A recording without a track,
    odometry or a second scan is a `RecordingError`.
    """
    path, scans = recording.path, recording.ranges
    if "track" not in recording.notes or recording.odometry is None or len(scans) < 2:
        record = "a metadata record named track (left and right, each [[x, y], ...] m in the frame of the odometry)"
        needed = f"{record}, odometry, and at least two scans"
        raise RecordingError(f"{path} lacks the positions of its cones: it needs {needed}.")
    track = track_of(recording)
    starts = torch.from_numpy(recording.poses()).float().t().unsqueeze(-1)
    angles = torch.from_numpy(recording.angles(slice(-1))).float()
    # The time of each range as a share of its scan, NaN for padding; the scanner turns clockwise.
    beam, points = np.arange(scans.shape[1]), recording.points[:-1, None]
    order = np.where(recording.angle_increment[:-1, None] > 0, points - 1 - beam, beam)
    phase = torch.from_numpy(np.where(beam < points, order / np.maximum(points, 1), np.nan)).float()
    poses = starts[:, :-1] + (starts[:, 1:] - starts[:, :-1]) * phase
    cones, radius = cones_of(track)
    true, hit = cast_beams(poses, angles, cones, radius)
    ranges = torch.from_numpy(scans[:-1])
    seconds = torch.from_numpy(recording.seconds[:-1])
    visibility = _visibility(poses, angles, cones, radius, hit)
    hit = torch.where(ranges.isfinite() & ((ranges - true).abs() > MAX_RANGE_ERROR), -1, hit)
    return SimulatedDrive(
        path.stem, track, "both", seconds, angles, ranges, hit, poses, cones, radius, visibility
    )


def track_of(recording: Recording) -> Track:
    """Return the track in a recording's metadata; raises a `RecordingError` if there is none, or it is not valid."""
    try:
        return noted_track(recording.notes.get("track", {}))
    except TrackError as error:
        raise RecordingError(f"{recording.path}: {error}") from None


def save_drive(drive: SimulatedDrive, path: Path) -> None:
    """Write the scans and the odometry of a drive as MCAP; the track is noted for a drive past both sides."""
    rate = float(1 / drive.seconds[1])
    notes = _notes({"drive": drive.name}, drive.track if drive.sides == "both" else None)
    _write(path, rate, drive.angles, drive.ranges, drive.poses[..., -1].t(), None, notes)


def record_labelling_drives(
    folder: Path, pairs: int = 5, both: int = 3, tick: Callable[[], Any] | None = None
) -> dict[Sides, list[str]]:
    """Record drives to train a cone classifier, `pairs` past each side, and `both` drives past both sides to test it.

    The result is the paths by side: `left_0.mcap`, `right_0.mcap`, `both_100.mcap`. `tick` is
    called after each drive.
    """
    paths: dict[Sides, list[str]] = {"left": [], "right": [], "both": []}
    for sides, files in paths.items():
        for seed in range(TEST_SEED, TEST_SEED + both) if sides == "both" else range(pairs):
            files.append(os.path.join(folder, f"{sides}_{seed}.mcap"))
            save_drive(simulated_drive(sides, seed), files[-1])
            if tick is not None:
                tick()
    return paths


@torch.no_grad()
def record_drives(
    env: EnvBase,
    policy: TensorDictModuleBase,
    paths: Sequence[Path],
    about: Mapping[str, str] | None = None,
    tick: Callable[[], Any] | None = None,
) -> None:
    """Run a policy on B simulated robots for an episode; write `/scan`, `/odom` and `/cmd_vel` of each robot as MCAP.

    The env is a `SimulatedRobotEnv` with or without transforms. The policy acts deterministically.
    The entries of `about`, such as the name of the policy, are noted in each file. `tick` is called
    after every step. Another kind of env, or another number of paths, is a `ValueError`.
    """
    base = env.base_env if isinstance(env, TransformedEnv) else env
    if not isinstance(base, SimulatedRobotEnv):
        raise ValueError(
            f"env is a {type(base).__name__}; give a SimulatedRobotEnv, which has scans to record"
        )
    robots = env.batch_size[0]
    if len(paths) != robots:
        raise ValueError(f"{len(paths)} paths for {robots} robots; give one file for each")
    state = env.eval().reset()
    track = base.track
    start = state["info", "pose"]
    rows: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []
    running = torch.ones(robots, dtype=torch.bool)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while running.any():
            scan, pose = base.scan, state["info", "pose"]
            step = env.step(policy(state))
            # The action that reached the robot: a transform may have changed the policy's.
            rows.append(
                (
                    running,
                    scan,
                    start,
                    step["next", "steering"].squeeze(-1),
                    step["next", "info", "pose"],
                )
            )
            # The robot stands during the first scan, so the second one starts at the same pose.
            start, running = pose, running & ~step["next", "done"].squeeze(-1)
            state = step_mdp(step)
            if tick is not None:
                tick()
    rows_of, scans, starts, actions, ends = (
        torch.stack(column) for column in zip(*rows, strict=True)
    )
    speed = base.step_length * base.lidar.rate
    turn_rate = (actions * base.max_steering).sin() * (speed / base.car_length)
    for robot, path in enumerate(paths):
        own = rows_of[:, robot]
        commands = torch.stack([torch.full_like(turn_rate, speed), turn_rate], -1)[own, robot]
        # The last scan ends at the second last pose; then the last command is executed.
        poses = torch.cat([starts[own, robot], ends[own, robot][-2:]])
        notes = _notes({"drive": "closed loop", **(about or {})}, base.tracks[int(track[robot])])
        _write(path, base.lidar.rate, base.lidar.angles, scans[own, robot], poses, commands, notes)


def _notes(drive: Mapping[str, str], track: Track | None) -> dict[str, dict[str, str]]:
    notes = {SIMULATED: {"sensor": "simulated RPLIDAR A1M8", **drive}}
    return notes if track is None else notes | {"track": track_notes(track)}


def _write(
    path: Path,
    rate: float,
    angles: Tensor,
    ranges: Tensor,
    poses: Tensor,
    commands: Tensor | None,
    notes: Mapping[str, Mapping[str, str]],
) -> None:
    """Write scans [T, P] m, the poses at their starts and after [T or more, 3], and the commands after them [T, 2]."""
    times = [round(scan / rate * 1e9) for scan in range(max(len(ranges) + 1, len(poses)))]
    beams, angle_min = len(angles), float(angles[0])
    increment = 2 * math.pi / beams
    scanner = {
        "angle_min": angle_min,
        "angle_max": angle_min + increment * (beams - 1),
        "angle_increment": increment,
        "time_increment": 1 / rate / beams,
        "scan_time": 1 / rate,
        "range_min": RANGE_MIN,
        "range_max": RANGE_MAX,
    }
    with RecordingWriter(path) as writer:
        for name, entries in notes.items():
            writer.describe(name, entries)
        for index, (start, end, scan) in enumerate(
            zip(times, times[1:], ranges.numpy(), strict=False)
        ):
            writer.add(
                "/scan", SCAN, end, {"header": header(start, "laser"), "ranges": scan, **scanner}
            )
            if commands is not None:
                writer.add("/cmd_vel", TWIST, end, twist(*commands[index].tolist()))
        for time, (x, y, heading) in zip(times, poses.tolist(), strict=False):
            orientation = {"z": math.sin(heading / 2), "w": math.cos(heading / 2)}
            pose = {"pose": {"position": {"x": x, "y": y}, "orientation": orientation}}
            fields = {"header": header(time, "odom"), "child_frame_id": "base_link", "pose": pose}
            writer.add("/odom", ODOMETRY, time, fields)


def _visibility(
    poses: Tensor, angles: Tensor, cones: Tensor, radius: Tensor, hit: Tensor
) -> Tensor:
    """Return the share of the beams towards each cone that hit it [T, M]; `hit` [T, P] is the cone of each beam."""
    alone = [
        cast_beams(poses, angles, cones[:, [m]], radius[[m]])[0].isfinite().sum(-1)
        for m in range(len(radius))
    ]
    hits = torch.stack([(hit == m).sum(-1) for m in range(len(radius))], -1)
    return hits / torch.stack(alone, -1).clamp(min=1)
