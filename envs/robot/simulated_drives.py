"""Simulated drives: what a LiDAR says along the middle of a robot's track, and whose every point is.

The classifier learns from two kinds of drive, one with the left cones alone and one with the right ones alone: then no
person has to label anything. On a drive with both sides it is known here what each cluster really was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from coil_rl.envs.robot.course import THICK, THIN, cones_of, middle_line, robot_track
from coil_rl.envs.robot.lidar import SimulatedLidar, cast
from coil_rl.envs.track import Track

Sides = Literal["left", "right", "both"]

SPEED = 0.15  # m/s
SWAY = 0.04  # m, how far the drive leaves the middle


@dataclass(frozen=True, eq=False)
class SimulatedDrive:
    """Scans of a simulated robot and the truth about them.

    Attributes:
        name: of the drive.
        track: on which it was.
        sides: whose cones stood there.
        seconds: [T], when each scan began.
        angles: [P] radians, of the beams.
        ranges: [T, P] m, infinite for no return.
        hit: [T, P], the cone each range tells of, -1 for none.
        poses: [3, T, P], of the sensor as each beam was sent (m, m, radians).
        cones: [2, M] m, centres.
        radius: [M] m.
        visibility: [T, M], share of the beams that would meet a cone if it stood alone and do meet it; 0 for none.
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
        """Which of the cones [M] are thick."""
        return self.radius > (THIN + THICK) / 2


def simulated_drive(
    sides: Sides,
    seed: int,
    *,
    track: Track | None = None,
    lidar: SimulatedLidar | None = None,
    laps: int = 1,
    speed: float = SPEED,
    sway: float = SWAY,
) -> SimulatedDrive:
    """A robot that drives along the middle of a track, swaying a little.

    Args:
        sides: whose cones stand there.
        seed: of the noise, and of how it sways.
        track: None for `robot_track()`.
        lidar: None for one with its defaults.
        laps: how many.
        speed: m/s.
        sway: m, how far to either side.

    Raises:
        ValueError: for sides that do not exist.
    """
    if sides not in ("left", "right", "both"):
        raise ValueError(f"sides={sides!r} must be one of left, right, both")
    track, lidar = track or robot_track(), lidar or SimulatedLidar()
    generator = torch.Generator().manual_seed(seed)
    line = torch.from_numpy(np.tile(middle_line(track, speed / lidar.rate), (laps, 1)))
    swing, start = torch.rand(2, generator=generator, dtype=torch.float64)
    path = _swaying(line, sway, waves=3 + 5 * float(swing), start=float(start))
    poses = _poses(path, lidar.phase)
    place, radius = cones_of(track, left=sides != "right", right=sides != "left")
    true, hit = lidar.cast(poses, place, radius)
    ranges, stray = lidar.measure(true, generator)
    return SimulatedDrive(
        name=f"{sides}_{seed}",
        track=track,
        sides=sides,
        seconds=torch.arange(len(ranges), dtype=torch.float64) / lidar.rate,
        angles=lidar.angles,
        ranges=ranges,
        hit=torch.where(stray, -1, hit),
        poses=poses,
        cones=place,
        radius=radius,
        visibility=visibility(poses, lidar.angles, place, radius, hit),
    )


def labelling_drives(seeds: Sequence[int], **drive: object) -> list[SimulatedDrive]:
    """For each seed a drive past the left cones alone and one past the right cones alone."""
    return [simulated_drive(side, seed, **drive) for seed in seeds for side in ("left", "right")]  # type: ignore


def visibility(poses: Tensor, angles: Tensor, cones: Tensor, radius: Tensor, hit: Tensor) -> Tensor:
    """Share of the beams that would meet a cone if it stood alone and do meet it, [T, M]; 0 where none would.

    Args:
        poses: of the sensor as each beam is sent, [3, T, P] (m, m, radians).
        angles: of the beams, [P] radians.
        cones: centres, [2, M] m.
        radius: [M] m.
        hit: [T, P], the cone that each beam meets.
    """
    alone = [cast(poses, angles, cones[:, [m]], radius[[m]])[0].isfinite().sum(-1) for m in range(len(radius))]
    met = torch.stack([(hit == m).sum(-1) for m in range(len(radius))], -1)
    return met / torch.stack(alone, -1).clamp(min=1)


def _swaying(line: Tensor, sway: float, waves: float, start: float) -> Tensor:
    """A closed line [T, 2] moved to and fro across itself, `waves` times."""
    along = line.roll(-1, 0) - line.roll(1, 0)
    across = torch.stack([-along[:, 1], along[:, 0]], 1) / along.norm(dim=1, keepdim=True)
    turns = torch.linspace(0, waves, len(line), dtype=line.dtype) + start
    return line + sway * (2 * torch.pi * turns).sin().unsqueeze(1) * across


def _poses(path: Tensor, phase: Tensor) -> Tensor:
    """Poses [3, T - 2, P] while each beam is sent, on the way from each point of a path [T, 2] to the next."""
    here, after = path[:-1], path[1:]
    way = after - here
    heading = torch.atan2(way[:, 1], way[:, 0])
    turn = torch.remainder(heading[1:] - heading[:-1] + torch.pi, 2 * torch.pi) - torch.pi
    place = here[:-1, :, None] + way[:-1, :, None] * phase
    return torch.cat([place, (heading[:-1, None] + turn[:, None] * phase).unsqueeze(1)], 1).transpose(0, 1).float()
