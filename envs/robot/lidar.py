"""Simulated LiDAR: the distance along each beam of a rotating, moving sensor to the nearest cone.

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
    """Range measurements with the noise of an RPLIDAR A1M8.

    Args:
        beams: P, points per scan.
        rate: scans per second.
        noise: m, standard deviation of a range at distance 0.
        noise_growth: 1/m, increase of the standard deviation per square metre of distance.
        quantum: m, resolution of the ranges.
        no_return: share of beams without a return, from 0 to 1.
        outliers: share of beams with a random range, from 0 to 1.

    Raises:
        ValueError: for a value outside its range.

    Attributes:
        angles: [P] radians, bearings of the beams, ascending.
        phase: [P], time of each beam as a share of the scan.
    """

    beams: int = 360
    rate: float = 5.5
    noise: float = 0.0007
    noise_growth: float = 0.001
    quantum: float = 0.00025
    no_return: float = 0.02
    outliers: float = 0.005

    def __post_init__(self) -> None:
        check_range(0, above=True, beams=self.beams, rate=self.rate, quantum=self.quantum)
        check_range(0, noise=self.noise, noise_growth=self.noise_growth)
        if min(self.no_return, self.outliers) < 0 or self.no_return + self.outliers > 1:
            raise ValueError(
                f"no_return={self.no_return} and outliers={self.outliers} must be shares of all "
                "beams"
            )
        beams = self.beams
        # As in rplidar_ros, a scan starts and ends behind the robot. The sensor turns clockwise but
        # bearings ascend, so the last beam is measured first.
        steps = torch.arange(1, beams + 1, dtype=torch.float64)
        self.angles = (steps * (2 * math.pi / beams) - math.pi).float()
        self.phase = torch.arange(beams - 1, -1, -1) / beams

    def measure(self, true: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Measure distances with noise.

        The number of random draws does not depend on the distances.

        Args:
            true: the true distances, [B, P] m, infinite for no cone.
            generator: of the noise.

        Returns:
            The measured ranges [B, P] m, infinite without a return, and which of them are outliers
            [B, P].
        """
        noise = torch.randn(true.shape, generator=generator)
        chance, uniform = torch.rand(2, *true.shape, generator=generator)
        deviation = self.noise + self.noise_growth * true.clamp(max=RANGE_MAX).square()
        ranges = true + noise * deviation
        outlier = chance < self.outliers
        ranges = torch.where(outlier, RANGE_MIN + (RANGE_MAX - RANGE_MIN) * uniform, ranges)
        ranges = (ranges / self.quantum).round() * self.quantum
        lost = (chance >= 1 - self.no_return) | (ranges < RANGE_MIN) | (ranges > RANGE_MAX)
        return torch.where(lost, torch.inf, ranges), outlier


def cast_beams(
    poses: Tensor, angles: Tensor, cones: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the true distance along each beam to the first surface, and the cone that it hits.

    Args:
        poses: [3, B, P] (m, m, radians), sensor pose at the time of each beam.
        angles: [P] radians, bearings of the beams, or [B, P] if each sensor has its own.
        cones: centres, [2, M] m, or [2, B, M] if each sensor has its own.
        radius: of the cones, [M] or [B, M] m.

    Returns:
        The distance [B, P] m, infinite without a cone, and the index of the cone [B, P], -1 without
        one.
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
    """Return poses after arcs, [3, *batch] (m, m, radians).

    Args:
        pose: before the arcs, [3, *batch].
        distance: length of each arc, m.
        turn: change of heading along each arc, radians.
    """
    x, y, heading = pose
    # The chord of an arc is shorter than the arc by sin(h) / h, h half the turn.
    chord = distance * torch.sinc(turn / (2 * math.pi))
    direction = heading + turn / 2
    return torch.stack([x + chord * direction.cos(), y + chord * direction.sin(), heading + turn])
