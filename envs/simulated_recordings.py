"""Simulated drives as MCAP recordings, with the topics and clocks of a real robot's; each says that it is simulated.

A turn of the LiDAR is stamped with the time at which it began and logged when it was over. Then the robot is told how
to move, and does so during the next turn. The odometry tells where each turn began.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from coil_rl.envs.recording_writer import RecordingWriter
from coil_rl.envs.recordings import SIMULATED
from coil_rl.envs.ros_messages import LaserScan, Odometry, Twist
from coil_rl.envs.simulated_drives import SimulatedDrive
from coil_rl.envs.simulated_lidar import LEAST, MOST
from coil_rl.envs.simulated_robot import SimulatedRobotEnv

Path = str | os.PathLike[str]


def save_drive(drive: SimulatedDrive, path: Path) -> None:
    """Write a drive along the middle of a track: `/scan` and `/odom`.

    Args:
        drive: such as a labelling drive.
        path: the MCAP file to be.
    """
    rate = float(1 / drive.seconds[1])
    _write(path, rate, drive.angles, drive.ranges, drive.poses[..., 0].t(), None, {"drive": drive.name})


@torch.no_grad()
def record_drives(
    env: SimulatedRobotEnv, policy: TensorDictModuleBase, paths: Sequence[Path], about: Mapping[str, str] | None = None
) -> None:
    """Let a policy drive simulated robots for an episode, and write `/scan`, `/odom` and `/cmd_vel` of each.

    Args:
        env: B robots, without transforms.
        policy: writes the action; it does not sample.
        paths: the B MCAP files to be.
        about: what else to note in each file, such as the policy's name.

    Raises:
        ValueError: if there are not as many paths as robots.
    """
    robots = env.batch_size[0]
    if len(paths) != robots:
        raise ValueError(f"{len(paths)} paths for {robots} robots; give one file for each")
    state = env.reset()
    began = state["info", "pose"]
    rows: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    on = torch.ones(robots, dtype=torch.bool)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while on.any():
            scan, here = env.scan, state["info", "pose"]
            step = env.step(policy(state))
            rows.append((on, scan, began, step["action"].squeeze(-1)))
            # The first turn was made standing, so the second one begins where the first one did.
            began, on = here, on & ~step["next", "done"].squeeze(-1)
            state = step_mdp(step)
    running, scans, poses, actions = (torch.stack(column) for column in zip(*rows, strict=True))
    speed = env.step_length * env.lidar.rate
    turning = (actions * env.max_steering).sin() * (speed / env.car_length)
    notes = {"drive": "closed loop", **(about or {})}
    for robot, path in enumerate(paths):
        own = running[:, robot]
        told = torch.stack([torch.full_like(turning, speed), turning], -1)[own, robot]
        _write(path, env.lidar.rate, env.lidar.angles, scans[own, robot], poses[own, robot], told, notes)


def _write(
    path: Path,
    rate: float,
    angles: Tensor,
    ranges: Tensor,
    poses: Tensor,
    commands: Tensor | None,
    notes: dict[str, str],
) -> None:
    """Write turns [T, P] m, where each began [T, 3] and what the robot was told after each [T, 2]."""
    times = [round(turn / rate * 1e9) for turn in range(len(ranges) + 1)]
    step = 2 * math.pi / len(angles)
    with RecordingWriter(path) as drive:
        drive.describe(SIMULATED, {"sensor": "simulated RPLIDAR A1M8", **notes})
        for turn, (began, over) in enumerate(pairwise(times)):
            scan = LaserScan(began, float(angles[0]), step, LEAST, MOST, ranges[turn].numpy(), 1 / rate)
            drive.add("/scan", "sensor_msgs/msg/LaserScan", time=over, data=scan.to_bytes())
            place = Odometry(began, *poses[turn].tolist())
            drive.add("/odom", "nav_msgs/msg/Odometry", time=over, data=place.to_bytes())
            if commands is not None:
                told = Twist(*commands[turn].tolist())
                drive.add("/cmd_vel", "geometry_msgs/msg/Twist", time=over, data=told.to_bytes())
