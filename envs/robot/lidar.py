"""Simulated LiDAR: the distance along each beam of a rotating, moving sensor to the nearest of several upright cones.

The defaults are those of an RPLIDAR A1M8 (360 points per scan, 5.5 scans per second). A cone is a
disc in the plane of the beams. A nearer cone hides a farther one, and the robot moves during a
scan.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from coil_rl.envs.limits import check_range

RANGE_MIN = 0.15  # m, minimum range of the sensor
RANGE_MAX = 12.0  # m, maximum range


@dataclass(eq=False)
class SimulatedLidar:
    """Range measurements with the noise of an RPLIDAR A1M8; raises a `ValueError` for a value outside its range."""

    beams: int = 360  # P, points per scan
    rate: float = 5.5  # scans per second
    noise: float = 0.0007  # m, standard deviation of a range at distance 0
    noise_growth: float = (
        0.001  # 1/m, increase of the standard deviation per square metre of distance
    )
    quantum: float = 0.00025  # m, resolution of the ranges
    no_return: float = 0.02  # share of beams without a return
    outliers: float = 0.005  # share of beams with a random range

    def __post_init__(self) -> None:
        check_range(0, above=True, beams=self.beams, rate=self.rate, quantum=self.quantum)
        check_range(0, noise=self.noise, noise_growth=self.noise_growth)
        if min(self.no_return, self.outliers) < 0 or self.no_return + self.outliers > 1:
            raise ValueError(
                f"no_return={self.no_return} and outliers={self.outliers} must be shares of all beams"
            )
        beams = self.beams
        # As in rplidar_ros, a scan starts and ends behind the robot. The sensor turns clockwise but
        # bearings ascend, so the last beam is measured first.
        self.angles = (
            torch.arange(1, beams + 1, dtype=torch.float64) * (2 * math.pi / beams) - math.pi
        ).float()
        # Time of each beam as a share of the scan.
        self.phase = torch.arange(beams - 1, -1, -1) / beams

    def measure(self, true: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return noisy ranges [B, P] m of true distances, infinite without a return; and which are outliers [B, P].

        The number of random draws does not depend on the distances, which are infinite for no cone.
        """
        noise = torch.randn(true.shape, generator=generator)
        chance, uniform = torch.rand(2, *true.shape, generator=generator)
        ranges = true + noise * (
            self.noise + self.noise_growth * true.clamp(max=RANGE_MAX).square()
        )
        outlier = chance < self.outliers
        ranges = torch.where(outlier, RANGE_MIN + (RANGE_MAX - RANGE_MIN) * uniform, ranges)
        ranges = (ranges / self.quantum).round() * self.quantum
        lost = (chance >= 1 - self.no_return) | (ranges < RANGE_MIN) | (ranges > RANGE_MAX)
        return torch.where(lost, torch.inf, ranges), outlier


def cast_beams(
    poses: Tensor, angles: Tensor, cones: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the true distance along each beam to the first surface [B, P] m, and the index of the cone it hits [B, P].

    Without a cone the distance is infinite and the index -1.

    Args:
        poses: [3, B, P] (m, m, radians), sensor pose at the time of each beam.
        angles: [P] radians, bearings of the beams, or [B, P] if each sensor has its own.
        cones: centres, [2, M] m, or [2, B, M] if each sensor has its own.
        radius: [M] or [B, M] m.
    """
    direction = poses[2] + angles
    cos, sin = direction.cos().unsqueeze(-1), direction.sin().unsqueeze(-1)
    x, y = (
        centre.unsqueeze(-2) - sensor.unsqueeze(-1)
        for centre, sensor in zip(cones, poses[:2], strict=True)
    )
    along = x * cos + y * sin
    across = y * cos - x * sin
    half_chord_squared = radius.square().unsqueeze(-2) - across.square()
    distance = along - half_chord_squared.clamp(min=0).sqrt()
    nearest, cone = torch.where((half_chord_squared > 0) & (along > 0), distance, torch.inf).min(-1)
    return nearest, torch.where(nearest.isfinite(), cone, -1)


def move_along_arc(pose: Tensor, distance: Tensor, turn: Tensor) -> Tensor:
    """Return the pose [3, *batch] (m, m, radians) after an arc of a length in m and a change of heading in radians."""
    x, y, heading = pose
    # The chord of an arc is shorter than the arc by sin(h) / h, h half the turn.
    chord = distance * torch.sinc(turn / (2 * math.pi))
    direction = heading + turn / 2
    return torch.stack([x + chord * direction.cos(), y + chord * direction.sin(), heading + turn])
