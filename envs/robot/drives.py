"""Drives of simulated robots: scripted ones with the truth about each range, and recordings.

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
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, TransformedEnv, set_exploration_type, step_mdp

from coil_rl.envs.recordings.folders import RecordingError
from coil_rl.envs.recordings.mcap_files import RecordingWriter
from coil_rl.envs.recordings.messages import ODOMETRY, SCAN, TWIST, header, twist
from coil_rl.envs.recordings.recording import SIMULATED, Recording
from coil_rl.envs.robot.course import (
    THICK,
    THIN,
    Sides,
    cones_of,
    middle_line,
    noted_track,
    robot_track,
    track_notes,
)
from coil_rl.envs.robot.env import SimulatedRobotEnv
from coil_rl.envs.robot.lidar import RANGE_MAX, RANGE_MIN, SimulatedLidar, cast_beams
from coil_rl.envs.track import Track, TrackError
from coil_rl.ranges import checked

Path = str | os.PathLike[str]

SPEED = 0.15  # m/s
SWAY = 0.04  # m, greatest distance to the centre line
TEST_SEED = 100  # first seed of the test drives; training drives have smaller ones
MAX_RANGE_ERROR = 0.03  # m, a range with a greater error is an outlier


@dataclass(frozen=True, eq=False)
class SimulatedDrive:
    """T scans of a drive with their ground truth.

    Attributes:
        name: of the drive.
        track: on which the robot drove.
        sides: the sides of the track that have cones.
        seconds: [T] s, start of each scan.
        angles: radians, bearings of the beams, [P], or [T, P] if each scan has its own.
        ranges: [T, P] m, infinite without a return.
        hit: [T, P], index of the cone of each range, -1 for none.
        poses: [3, T, P], sensor pose at the time of each beam (m, m, radians), NaN for padding.
        cones: [2, M] m, centres.
        radius: [M] m, of the cones.
        visibility: [T, M], share of a cone's beams that no nearer cone blocks; 0 for a cone without
            beams.
    """

    name: str
    track: Track
    sides: Sides
    seconds: Tensor
    angles: Tensor
    ranges: Tensor
    hit: Tensor
    poses: Tensor
    cones: Tensor
    radius: Tensor
    visibility: Tensor

    @property
    def thick(self) -> Tensor:
        """Whether each cone is thick, [M]."""
        return self.radius > (THIN + THICK) / 2


@checked
def simulated_drive(sides: Sides, seed: int, lidar: SimulatedLidar | None = None) -> SimulatedDrive:
    """Simulate a lap along the centre line of `robot_track()`.

    Args:
        sides: of the track with cones, "left", "right" or "both"; else a `ValueError`.
        seed: of the noise and of the sway.
        lidar: the sensor; None for an RPLIDAR A1M8.
    """
    track, lidar = robot_track(), lidar or SimulatedLidar()
    generator = torch.Generator().manual_seed(seed)
    line = torch.from_numpy(middle_line(track, SPEED / lidar.rate))
    poses = _poses_along(_swaying(line, generator), lidar.phase)
    cones, radius = cones_of(track, sides)
    true, hit = cast_beams(poses, lidar.angles, cones, radius)
    ranges, outlier = lidar.measure(true, generator)
    return SimulatedDrive(
        name=f"{sides}_{seed}",
        track=track,
        sides=sides,
        seconds=torch.arange(len(ranges), dtype=torch.float64) / lidar.rate,
        angles=lidar.angles,
        ranges=ranges,
        hit=torch.where(outlier, -1, hit),
        poses=poses,
        cones=cones,
        radius=radius,
        visibility=_visibility(poses, lidar.angles, cones, radius, hit),
    )


def _swaying(line: Tensor, generator: torch.Generator) -> Tensor:
    """Displace a closed line [T, 2] m sideways by a sine of random phase and frequency."""
    waves, phase = torch.rand(2, generator=generator, dtype=torch.float64)
    along = line.roll(-1, 0) - line.roll(1, 0)
    across = torch.stack([-along[:, 1], along[:, 0]], 1) / along.norm(dim=1, keepdim=True)
    periods = torch.linspace(0, 3 + 5 * float(waves), len(line), dtype=line.dtype) + float(phase)
    return line + SWAY * (2 * torch.pi * periods).sin().unsqueeze(1) * across


def _poses_along(path: Tensor, phase: Tensor) -> Tensor:
    """Return the pose of the sensor at the time of each beam, one scan for each step of a path.

    Args:
        path: [T + 2, 2] m, the position at the start of each scan.
        phase: [P], time of each beam as a share of its scan.

    Returns:
        Poses [3, T, P] (m, m, radians).
    """
    way = path[1:] - path[:-1]
    heading = torch.atan2(way[:, 1], way[:, 0])
    turn = torch.remainder(heading[1:] - heading[:-1] + torch.pi, 2 * torch.pi) - torch.pi
    position = path[:-2, :, None] + way[:-1, :, None] * phase
    bearing = (heading[:-1, None] + turn[:, None] * phase).unsqueeze(1)
    return torch.cat([position, bearing], 1).transpose(0, 1).float()


def labelled_drive(recording: Recording) -> SimulatedDrive:
    """Return a recorded drive, simulated or real, with its ground truth.

    The truth follows from its odometry and its track. The last scan is left out, as the pose at its
    end is unknown.

    Args:
        recording: with odometry, a track in its metadata and at least two scans, else a
            `RecordingError`.
    """
    path, scans = recording.path, recording.ranges
    if "track" not in recording.notes or recording.odometry is None or len(scans) < 2:
        raise RecordingError(
            f"{path} lacks the positions of its cones: it needs a metadata record named track "
            "(left and right, each [[x, y], ...] m in the frame of the odometry), odometry, and "
            "at least two scans."
        )
    track = track_of(recording)
    starts = torch.from_numpy(recording.poses()).float().t().unsqueeze(-1)
    angles = torch.from_numpy(recording.angles(slice(-1))).float()
    poses = starts[:, :-1] + (starts[:, 1:] - starts[:, :-1]) * _phase_of(recording)
    cones, radius = cones_of(track)
    true, hit = cast_beams(poses, angles, cones, radius)
    ranges = torch.from_numpy(scans[:-1])
    outlier = ranges.isfinite() & ((ranges - true).abs() > MAX_RANGE_ERROR)
    return SimulatedDrive(
        name=path.stem,
        track=track,
        sides="both",
        seconds=torch.from_numpy(recording.seconds[:-1]),
        angles=angles,
        ranges=ranges,
        hit=torch.where(outlier, -1, hit),
        poses=poses,
        cones=cones,
        radius=radius,
        visibility=_visibility(poses, angles, cones, radius, hit),
    )


def _phase_of(recording: Recording) -> Tensor:
    """Return the time of each range as a share of its scan, without the last scan: [T - 1, P].

    It is NaN for padding. The scanner turns clockwise, so ascending bearings are measured last to
    first.
    """
    beam, points = np.arange(recording.ranges.shape[1]), recording.points[:-1, None]
    order = np.where(recording.angle_increment[:-1, None] > 0, points - 1 - beam, beam)
    phase = np.where(beam < points, order / np.maximum(points, 1), np.nan)
    return torch.from_numpy(phase).float()


def track_of(recording: Recording) -> Track:
    """Return the track in a recording's metadata; without a valid one, raise a `RecordingError`."""
    try:
        return noted_track(recording.notes.get("track", {}))
    except TrackError as error:
        raise RecordingError(f"{recording.path}: {error}") from None


def save_drive(drive: SimulatedDrive, path: Path) -> None:
    """Write the scans and the odometry of a drive as MCAP.

    Args:
        drive: the drive; its track is noted in the metadata if it has cones on both sides.
        path: of the file, which is replaced if it exists.
    """
    rate = float(1 / drive.seconds[1])
    notes = _notes({"drive": drive.name}, drive.track if drive.sides == "both" else None)
    _write(path, rate, drive.angles, drive.ranges, drive.poses[..., -1].t(), None, notes)


def record_labelling_drives(
    folder: Path, pairs: int = 5, both: int = 3, tick: Callable[[], Any] = lambda: None
) -> dict[Sides, list[str]]:
    """Record drives to train a cone classifier, and drives to test it.

    Args:
        folder: for the files `left_0.mcap`, `right_0.mcap`, `both_100.mcap`, ...
        pairs: number of drives past the left side, and past the right side, to train.
        both: number of drives past both sides, to test.
        tick: called after each drive.

    Returns:
        The paths by side.
    """
    paths: dict[Sides, list[str]] = {"left": [], "right": [], "both": []}
    for sides, files in paths.items():
        seeds = range(TEST_SEED, TEST_SEED + both) if sides == "both" else range(pairs)
        for seed in seeds:
            files.append(os.path.join(folder, f"{sides}_{seed}.mcap"))
            save_drive(simulated_drive(sides, seed), files[-1])
            tick()
    return paths


@torch.no_grad()
def record_drives(
    env: EnvBase,
    policy: TensorDictModuleBase,
    paths: Sequence[Path],
    about: Mapping[str, str] | None = None,
    tick: Callable[[], Any] = lambda: None,
) -> None:
    """Run a policy on B simulated robots for an episode, and record each robot as MCAP.

    A file has the topics `/scan`, `/odom` and `/cmd_vel`.

    Args:
        env: a `SimulatedRobotEnv` with or without transforms.
        policy: acts deterministically.
        paths: B files, one for each robot.
        about: entries, such as the name of the policy, that are noted in each file.
        tick: called after every step.

    Raises:
        ValueError: for another kind of env, or another number of paths.
    """
    base = env.base_env if isinstance(env, TransformedEnv) else env
    if not isinstance(base, SimulatedRobotEnv):
        raise ValueError(
            f"env is a {type(base).__name__}; give a SimulatedRobotEnv, which has scans to record"
        )
    robots = env.batch_size[0]
    if len(paths) != robots:
        raise ValueError(f"{len(paths)} paths for {robots} robots; give one file for each")
    steps = _run_episode(env, base, policy, tick)
    speed = base.step_length * base.lidar.rate
    turn_rate = (steps["action"] * base.max_steering).sin() * (speed / base.car_length)
    commands = torch.stack([torch.full_like(turn_rate, speed), turn_rate], -1)
    for robot, path in enumerate(paths):
        running = steps["running"][robot]
        own = steps[robot][running]
        # The last scan ends at the second last pose; then the last command is executed.
        poses = torch.cat([own["start"], own["end"][-2:]])
        track = base.tracks[int(base.track[robot])]
        notes = _notes({"drive": "closed loop", **(about or {})}, track)
        ordered = commands[robot][running]
        _write(path, base.lidar.rate, base.lidar.angles, own["scan"], poses, ordered, notes)


def _run_episode(
    env: EnvBase,
    base: SimulatedRobotEnv,
    policy: TensorDictModuleBase,
    tick: Callable[[], Any],
) -> TensorDict:
    """Run a policy until the episodes of all robots of `base`, which is inside `env`, are over.

    Returns:
        Entries [B, T, ...]: `running`, whether the episode of the robot was not over yet; `scan`
        [P] m, to which the robot reacted; `start` [3], pose at the start of this scan; `action`,
        the one that reached the robot; `end` [3], pose after the step.
    """
    state = env.eval().reset()
    start = state["info", "pose"]
    steps: list[TensorDict] = []
    running = torch.ones(env.batch_size[0], dtype=torch.bool)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while running.any():
            scan, pose = base.scan, state["info", "pose"]
            step = env.step(policy(state))
            after = step["next"]
            # A transform may have changed the policy's action.
            action, end = after["steering"].squeeze(-1), after["info", "pose"]
            noted = {"running": running, "scan": scan, "start": start, "action": action, "end": end}
            steps.append(TensorDict(noted, env.batch_size))
            # The robot stands during the first scan, so the second one starts at the same pose.
            start, running = pose, running & ~after["done"].squeeze(-1)
            state = step_mdp(step)
            tick()
    return torch.stack(steps, 1)


def _notes(drive: Mapping[str, str], track: Track | None) -> dict[str, dict[str, str]]:
    """Return the metadata records of a simulated drive, with its track unless it is None."""
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
    """Write a recording of a simulated robot.

    Args:
        rate: scans per second.
        angles: [P] radians, bearings of the beams.
        ranges: [T, P] m, the scans.
        poses: [T or more, 3], at the start of each scan and after it (m, m, radians).
        commands: [T, 2] m/s and radians/s, after each scan; None for none.
        notes: metadata records by name.
    """
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
        for index, scan in enumerate(ranges.numpy()):
            start, end = times[index], times[index + 1]
            fields = {"header": header(start, "laser"), "ranges": scan, **scanner}
            writer.add("/scan", SCAN, end, fields)
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
    """Return the share of the beams towards each cone that hit it, [T, M].

    Args:
        poses: [3, T, P], sensor pose at the time of each beam.
        angles: radians, bearings of the beams, [P] or [T, P].
        cones: [2, M] m, centres.
        radius: [M] m.
        hit: [T, P], index of the cone that each beam hit, -1 for none.
    """
    hits, alone = [], []
    for m in range(len(radius)):
        hits.append((hit == m).sum(-1))
        # The beams that would hit the cone if there were no other one.
        distance, _ = cast_beams(poses, angles, cones[:, [m]], radius[[m]])
        alone.append(distance.isfinite().sum(-1))
    return torch.stack(hits, -1) / torch.stack(alone, -1).clamp(min=1)
