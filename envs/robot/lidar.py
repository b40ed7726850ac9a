"""Simulated LiDAR: the distance along each beam of a rotating, moving sensor to the nearest cone.

The defaults are those of an RPLIDAR A1M8 (360 points per scan, 5.5 scans per second). A cone is a
disc in the plane of the beams. A nearer cone hides a farther one, and the robot moves during a
scan.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from coil_rl.ranges import Count, NonNegative, Positive, checked

RANGE_MIN = 0.15  # m, minimum range of the sensor
RANGE_MAX = 12.0  # m, maximum range
MARGIN = 1e-3  # m and radians, more than the error of the windows of bearings


@checked
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

    beams: Count = 360
    rate: Positive = 5.5
    noise: NonNegative = 0.0007
    noise_growth: NonNegative = 0.001
    quantum: Positive = 0.00025
    no_return: float = 0.02
    outliers: float = 0.005

    def __post_init__(self) -> None:
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

    def measure(
        self, true: Tensor, generator: torch.Generator, different: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """Measure distances with noise.

        The number of random draws does not depend on the distances.

        Args:
            true: the true distances, [B, P] m, infinite for no cone.
            generator: of the noise.
            different: number of rows that draw; row i has the noise of row `i % different`. None:
                all rows draw.

        Returns:
            The measured ranges [B, P] m, infinite without a return, and which of them are outliers
            [B, P].
        """
        shape = true.shape if different is None else (different, *true.shape[1:])
        noise = torch.randn(shape, generator=generator)
        chance, uniform = torch.rand(2, *shape, generator=generator)
        if different is not None:
            rows = torch.arange(len(true)) % different
            noise, chance, uniform = noise[rows], chance[rows], uniform[rows]
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

    Of each cone only the beams in its window of bearings are computed, a few of a turn; the numbers
    are those of all pairs of beams and cones, to the last bit.

    Args:
        poses: [3, B, P] (m, m, radians), sensor pose at the time of each beam; NaN for a beam that
            hits nothing.
        angles: [P] radians, bearings of the beams, or [B, P] if each sensor has its own.
        cones: centres, [2, M] m, or [2, B, M] if each sensor has its own.
        radius: of the cones, [M] or [B, M] m.

    Returns:
        The distance [B, P] m, infinite without a cone, and the index of the cone [B, P], -1 without
        one.
    """
    sensors, beams = poses.shape[1:]
    sizes = (sensors, cones.shape[-1])
    centres = [(each if each.ndim == 2 else each.unsqueeze(0)).expand(sizes) for each in cones]
    pair, place = _pairs(*_windows(poses, angles, centres, radius.expand(sizes)))
    along, half_chord_squared = _chords(poses, angles, centres, radius.expand(sizes), pair, place)
    (hit,) = torch.where((half_chord_squared > 0) & (along > 0))
    place, cone = _taken(place, hit), _taken(pair, hit) % sizes[1]
    distance = _taken(along, hit) - _taken(half_chord_squared, hit).sqrt()
    nearest, index = _nearest(place, cone, distance, sensors * beams)
    return nearest.view(sensors, beams), index.view(sensors, beams)


def _nearest(place: Tensor, cone: Tensor, distance: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the smallest distance at each of some places, and the cone there, [size] each.

    Args:
        place: of each hit, [N].
        cone: of each hit, [N].
        distance: m, of each hit, [N].
    """
    nearest = torch.full((size,), torch.inf, dtype=distance.dtype)
    nearest = nearest.scatter_reduce(0, place, distance, "amin")
    (first,) = torch.where(distance == _taken(nearest, place))
    index = torch.full((size,), -1)
    return nearest, index.scatter(0, _taken(place, first), _taken(cone, first))


def _windows(
    poses: Tensor, angles: Tensor, centres: Sequence[Tensor], radius: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the beams that may hit each cone.

    They are those with the bearings from which it can be hit while the sensor moves and turns, as
    seen from its mean pose.

    Args:
        poses: as for `cast_beams`.
        angles: as for `cast_beams`.
        centres: x and y of the cones, [B, M] m each.
        radius: of the cones, [B, M] m.

    Returns:
        The first beam and the number of beams of each window, [B, M], counted by bearing and around
        the turn; and the beams by bearing, [B, P].
    """
    middle = poses.nanmean(-1, keepdim=True)
    away = (poses - middle).abs().nan_to_num(0.0).amax(-1, keepdim=True)
    x, y = centres[0] - middle[0], centres[1] - middle[1]
    reach = radius + (away[0] + away[1] + MARGIN)
    far = torch.hypot(x, y)
    half = torch.where(far > reach, (reach / far).clamp(max=1).asin(), math.pi)
    half = (half + away[2] + MARGIN).clamp(max=math.pi)
    order = angles.remainder(2 * math.pi).sort(-1)  # beams may go on beyond a turn
    lowest = order.values[..., :1]
    bearing = lowest + (torch.atan2(y, x) - middle[2] - lowest).remainder(2 * math.pi)
    turns = torch.cat([order.values + turn * 2 * math.pi for turn in (-1, 0, 1)], -1)
    start = torch.searchsorted(turns, bearing - half)
    count = torch.searchsorted(turns, bearing + half, right=True) - start
    beams = order.indices.expand(len(count), -1)
    return start, count.clamp(max=beams.shape[1]), beams


def _pairs(start: Tensor, count: Tensor, order: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pairs of the windows: of sensor and cone, and of sensor and beam, [N] each.

    They are indices into flattened tensors [B, M] and [B, P].

    Args:
        start: first beam of each window by bearing, [B, M].
        count: number of its beams, [B, M].
        order: the beams by bearing, [B, P].
    """
    sensors, beams = order.shape
    sizes = count.flatten()
    pair = torch.repeat_interleave(sizes)
    skipped = start.flatten() - (sizes.cumsum(0) - sizes)
    slot = (_taken(skipped, pair) + torch.arange(len(pair))) % beams
    of_sensor = (torch.arange(sensors) * beams).unsqueeze(-1)
    row = _taken(of_sensor.expand(count.shape), pair)
    return pair, row + _taken(order, row + slot)


def _chords(
    poses: Tensor,
    angles: Tensor,
    centres: Sequence[Tensor],
    radius: Tensor,
    pair: Tensor,
    place: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return where the beams of pairs pass cones: the way to there, m, and the half chord squared.

    Args:
        poses: as for `cast_beams`.
        angles: as for `cast_beams`.
        centres: x and y of the cones, [B, M] m each.
        radius: of the cones, [B, M] m.
        pair: of sensor and cone, [N].
        place: of sensor and beam, [N].
    """
    direction = poses[2] + angles
    cos, sin = (_taken(values, place) for values in (direction.cos(), direction.sin()))
    x, y = (
        _taken(centre, pair) - _taken(sensor, place)
        for centre, sensor in zip(centres, poses[:2], strict=True)
    )
    across = y * cos - x * sin
    return x * cos + y * sin, _taken(radius.square(), pair) - across.square()


def _taken(values: Tensor, index: Tensor) -> Tensor:
    """Return elements of a flattened tensor."""
    return values.reshape(-1).index_select(0, index)


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
