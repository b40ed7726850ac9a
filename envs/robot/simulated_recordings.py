"""Simulated drives as MCAP recordings, with the topics and clocks of a real robot's; each says that it is simulated.

A turn of the LiDAR is stamped with the time at which it began and logged when it was over. Then the robot is told how
to move, and does so during the next turn. The odometry tells where each turn began, and where the robot was in the end.
What stood where is noted in the recording, in the frame of its odometry: `track`, both rings of cones and the start.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from coil_rl.envs.recordings.reading import SIMULATED, Recording, RecordingError
from coil_rl.envs.recordings.ros_messages import LaserScan, Odometry, Twist
from coil_rl.envs.recordings.writer import RecordingWriter
from coil_rl.envs.robot.course import cones_of, noted_track, track_notes
from coil_rl.envs.robot.lidar import LEAST, MOST, cast
from coil_rl.envs.robot.simulated_drives import Sides, SimulatedDrive, simulated_drive, visibility
from coil_rl.envs.robot.simulated_robot import SimulatedRobotEnv
from coil_rl.envs.track import Track, TrackError

Path = str | os.PathLike[str]
Notes = dict[str, dict[str, str]]

TEST_SEED = 100  # of the first drive to measure with; none to learn from gets so far
STRAY = 0.03  # m; a range that misses what it should have met by more tells of nothing that is there


def save_drive(drive: SimulatedDrive, path: Path) -> None:
    """Write a drive along the middle of a track: `/scan` and `/odom`.

    Args:
        drive: such as a labelling drive; only of one past both sides the track is noted.
        path: the MCAP file to be.
    """
    rate = float(1 / drive.seconds[1])
    notes = _notes({"drive": drive.name}, drive.track if drive.sides == "both" else None)
    _write(path, rate, drive.angles, drive.ranges, drive.poses[..., 0].t(), None, notes)


def record_labelling_drives(
    folder: Path, pairs: int = 5, both: int = 3, tick: Callable[[], Any] | None = None
) -> dict[Sides, list[str]]:
    """Write what a cone classifier learns from, drives past the cones of one side, and drives past both to measure it.

    Args:
        folder: gets `left_0.mcap`, `right_0.mcap`, `both_100.mcap` and so on.
        pairs: how many of each of the former.
        both: how many of the latter.
        tick: called after each drive.

    Returns:
        The paths of the drives past each side, and past both.
    """
    seeds = {"left": range(pairs), "right": range(pairs), "both": range(TEST_SEED, TEST_SEED + both)}
    found: dict[Sides, list[str]] = {"left": [], "right": [], "both": []}
    for sides, paths in found.items():
        for seed in seeds[sides]:
            paths.append(os.path.join(folder, f"{sides}_{seed}.mcap"))
            save_drive(simulated_drive(sides, seed), paths[-1])
            if tick is not None:
                tick()
    return found


def surveyed_drive(recording: Recording) -> SimulatedDrive:
    """A recorded drive, simulated or not, with the truth about its scans, from the odometry and the noted track.

    Its last turn is left out, for nothing tells where that one ended.

    Raises:
        RecordingError: if the recording lacks a track, odometry or a second turn, or its turns differ in their beams.
    """
    path, scans = recording.path, recording.ranges
    if "track" not in recording.notes or recording.odometry is None or len(scans) < 2:
        raise RecordingError(
            f"{path} does not tell where its cones stood: it needs a metadata record named track (left and right, each "
            "[[x, y], ...] m in the frame of the odometry), odometry, and at least two scans."
        )
    if (np.diff(recording.points) != 0).any() or np.ptp(recording.angle_min) or np.ptp(recording.angle_increment):
        raise RecordingError(
            f"{path} has turns with different bearings; record it anew with a scanner that keeps them."
        )
    track = track_of(recording)
    begin = torch.from_numpy(recording.poses()).float().t().unsqueeze(-1)
    angles = torch.from_numpy(recording.angles(0)).float()
    phase = torch.arange(len(angles)) / len(angles)
    poses = begin[:, :-1] + (begin[:, 1:] - begin[:, :-1]) * phase
    cones, radius = cones_of(track)
    true, hit = cast(poses, angles, cones, radius)
    ranges = torch.from_numpy(scans[:-1])
    said = torch.where(ranges.isfinite(), (ranges - true).abs(), 0)
    return SimulatedDrive(
        name=path.stem,
        track=track,
        sides="both",
        seconds=torch.from_numpy(recording.seconds[:-1]),
        angles=angles,
        ranges=ranges,
        hit=torch.where(said > STRAY, -1, hit),
        poses=poses,
        cones=cones,
        radius=radius,
        visibility=visibility(poses, angles, cones, radius, hit),
    )


def track_of(recording: Recording) -> Track:
    """The track that a recording notes.

    Raises:
        RecordingError: if it notes none, or one that is no track.
    """
    try:
        return noted_track(recording.notes.get("track", {}))
    except TrackError as error:
        raise RecordingError(f"{recording.path}: {error}") from None


@torch.no_grad()
def record_drives(
    env: EnvBase,
    policy: TensorDictModuleBase,
    paths: Sequence[Path],
    about: Mapping[str, str] | None = None,
    tick: Callable[[], Any] | None = None,
) -> None:
    """Let a policy drive simulated robots for an episode, and write `/scan`, `/odom` and `/cmd_vel` of each.

    Args:
        env: B robots, a `SimulatedRobotEnv` with or without transforms.
        policy: writes the action; it does not sample.
        paths: the B MCAP files to be.
        about: what else to note in each file, such as the policy's name.
        tick: called every step.

    Raises:
        ValueError: if there are not as many paths as robots, or these are no simulated robots.
    """
    bare = env.base_env if isinstance(env, TransformedEnv) else env
    if not isinstance(bare, SimulatedRobotEnv):
        raise ValueError(f"env is a {type(bare).__name__}; give a SimulatedRobotEnv, which has scans to record")
    robots = env.batch_size[0]
    if len(paths) != robots:
        raise ValueError(f"{len(paths)} paths for {robots} robots; give one file for each")
    state = env.eval().reset()
    track = bare.track
    began = state["info", "pose"]
    rows: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []
    on = torch.ones(robots, dtype=torch.bool)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while on.any():
            scan, here = bare.scan, state["info", "pose"]
            step = env.step(policy(state))
            # What the robot was told: a transform may have changed what the policy said.
            rows.append((on, scan, began, step["next", "steering"].squeeze(-1), step["next", "info", "pose"]))
            # The first turn was made standing, so the second one begins where the first one did.
            began, on = here, on & ~step["next", "done"].squeeze(-1)
            state = step_mdp(step)
            if tick is not None:
                tick()
    running, scans, begins, actions, after = (torch.stack(column) for column in zip(*rows, strict=True))
    speed = bare.step_length * bare.lidar.rate
    turning = (actions * bare.max_steering).sin() * (speed / bare.car_length)
    for robot, path in enumerate(paths):
        own = running[:, robot]
        told = torch.stack([torch.full_like(turning, speed), turning], -1)[own, robot]
        # The last turn is over where the one before was told to go, and then the last command is obeyed.
        poses = torch.cat([begins[own, robot], after[own, robot][-2:]])
        notes = _notes({"drive": "closed loop", **(about or {})}, bare.tracks[int(track[robot])])
        _write(path, bare.lidar.rate, bare.lidar.angles, scans[own, robot], poses, told, notes)


def _notes(drive: Mapping[str, str], track: Track | None) -> Notes:
    notes: Notes = {SIMULATED: {"sensor": "simulated RPLIDAR A1M8", **drive}}
    return notes if track is None else notes | {"track": track_notes(track)}


def _write(
    path: Path,
    rate: float,
    angles: Tensor,
    ranges: Tensor,
    poses: Tensor,
    commands: Tensor | None,
    notes: Notes,
) -> None:
    """Write turns [T, P] m, where each began and what came after [T or more, 3], and commands after each [T, 2]."""
    times = [round(turn / rate * 1e9) for turn in range(max(len(ranges) + 1, len(poses)))]
    step = 2 * math.pi / len(angles)
    with RecordingWriter(path) as drive:
        for name, entries in notes.items():
            drive.describe(name, entries)
        for turn in range(len(ranges)):
            began, over = times[turn], times[turn + 1]
            scan = LaserScan(began, float(angles[0]), step, LEAST, MOST, ranges[turn].numpy(), 1 / rate)
            drive.add("/scan", "sensor_msgs/msg/LaserScan", time=over, data=scan.to_bytes())
            if commands is not None:
                told = Twist(*commands[turn].tolist())
                drive.add("/cmd_vel", "geometry_msgs/msg/Twist", time=over, data=told.to_bytes())
        for time, pose in zip(times, poses.tolist(), strict=False):
            drive.add("/odom", "nav_msgs/msg/Odometry", time=time, data=Odometry(time, *pose).to_bytes())
