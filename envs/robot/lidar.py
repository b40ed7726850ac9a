"""A simulated LiDAR: rays from a turning, moving sensor to the nearest of several upright cones.

Its figures are those of an RPLIDAR A1M8 (360 points a turn at 5.5 turns a second). A cone is a disc where the plane of
the rays cuts it. A nearer cone hides a farther one, and while the sensor turns the robot drives on, so a scan is not
what could be seen from any one place.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LEAST = 0.15  # m, the sensor sees nothing nearer
MOST = 12.0  # m


class SimulatedLidar:
    """Measures distances as an RPLIDAR A1M8 does.

    Args:
        beams: P, points a turn.
        rate: turns a second.
        noise: m, standard deviation of a range at distance 0.
        noise_growth: 1/m, what is added to it per square metre of distance.
        quantum: m, ranges are multiples of this.
        no_return: share of beams that come back with nothing.
        outliers: share of beams that come back with any range.

    Raises:
        ValueError: for a value outside its range, naming it.

    Example:
        >>> lidar = SimulatedLidar(beams=4, no_return=0.0, outliers=0.0)
        >>> true, hit = lidar.cast(torch.zeros(3, 1, 4), torch.tensor([[1.0], [0.0]]), torch.tensor([0.045]))
        >>> true.tolist(), hit.tolist()
        ([[inf, 0.9549999833106995, inf, inf]], [[-1, 0, -1, -1]])
    """

    def __init__(
        self,
        beams: int = 360,
        rate: float = 5.5,
        noise: float = 0.0007,
        noise_growth: float = 0.001,
        quantum: float = 0.00025,
        no_return: float = 0.02,
        outliers: float = 0.005,
    ) -> None:
        for name, value in {"beams": beams, "rate": rate, "quantum": quantum}.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name}={value} must be a finite number above 0")
        for name, value in {"noise": noise, "noise_growth": noise_growth}.items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name}={value} must be a finite number of at least 0")
        if min(no_return, outliers) < 0 or no_return + outliers > 1:
            raise ValueError(f"no_return={no_return} and outliers={outliers} must be shares of all beams")
        self.beams, self.rate, self.quantum = beams, rate, quantum
        self.noise, self.noise_growth, self.no_return, self.outliers = noise, noise_growth, no_return, outliers
        # As the driver of the real one has it: the turn begins and ends behind the robot.
        self.angles = (torch.arange(1, beams + 1, dtype=torch.float64) * (2 * math.pi / beams) - math.pi).float()
        # When each beam is sent, as a share of the turn.
        self.phase = torch.arange(beams) / beams

    def cast(self, poses: Tensor, cones: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
        """The true distance along each beam to the first surface, and whose it is.

        Args:
            poses: of the sensor as each beam is sent, [3, B, P] (m, m, radians).
            cones: centres, [2, M] m, or [2, B, M] where each sensor stands among others.
            radius: [M] or [B, M] m.

        Returns:
            [B, P] m, infinite where a beam meets no cone, and the number of the cone it meets [B, P], -1 for none.
        """
        return cast(poses, self.angles, cones, radius)

    def measure(self, true: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """What the sensor says of true distances.

        Args:
            true: [B, P] m, infinite for nothing.
            generator: of the noise; the numbers drawn are the same for any distances.

        Returns:
            [B, P] m, infinite where nothing came back, and 1 where a range tells of nothing that is there [B, P].
        """
        noise = torch.randn(true.shape, generator=generator)
        fate, anywhere = torch.rand(2, *true.shape, generator=generator)
        said = true + noise * (self.noise + self.noise_growth * true.clamp(max=MOST).square())
        stray = fate < self.outliers
        said = torch.where(stray, LEAST + (MOST - LEAST) * anywhere, said)
        said = (said / self.quantum).round() * self.quantum
        lost = (fate >= 1 - self.no_return) | (said < LEAST) | (said > MOST)
        return torch.where(lost, torch.inf, said), stray


def cast(poses: Tensor, angles: Tensor, cones: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """What `SimulatedLidar.cast` does, for any sensor whose beams have the bearings `angles` [P] radians."""
    direction = poses[2] + angles
    ahead_x, ahead_y = direction.cos().unsqueeze(-1), direction.sin().unsqueeze(-1)
    x, y = (stand.unsqueeze(-2) - at.unsqueeze(-1) for stand, at in zip(cones, poses[:2], strict=True))
    along = x * ahead_x + y * ahead_y
    beside = y * ahead_x - x * ahead_y
    deep = radius.square().unsqueeze(-2) - beside.square()
    reach = along - deep.clamp(min=0).sqrt()
    nearest, cone = torch.where((deep > 0) & (along > 0), reach, torch.inf).min(-1)
    return nearest, torch.where(nearest.isfinite(), cone, -1)


def driven(pose: Tensor, distance: Tensor, turn: Tensor) -> Tensor:
    """Where a car is after it drove an arc.

    Args:
        pose: before, [3, *batch] (m, m, radians).
        distance: along the arc, m.
        turn: how far it turned on it, radians.
    """
    x, y, heading = pose
    # The chord of an arc is shorter than the arc by sin(h) / h, h half the turn.
    chord = distance * torch.sinc(turn / (2 * math.pi))
    towards = heading + turn / 2
    return torch.stack([x + chord * towards.cos(), y + chord * towards.sin(), heading + turn])
