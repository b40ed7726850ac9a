"""What a car sees: the cones in view, the boundary estimated from them, and the 20 numbers of the observation.

Shared by every world that shows cones to an agent. The batch comes last; the two sides are `[..., 2, B]`, left first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from coil_rl.envs.sorting import smallest
from coil_rl.envs.splines import Spline, slots_in_use

SAMPLES = 5
SIGHT = 7.0
HALF_FIELD_OF_VIEW = math.radians(60)
WIDEST_ANGLE = math.radians(120)

Fit = Callable[[Tensor, Tensor], Spline]


@dataclass(frozen=True)
class View:
    """The cones in sight of a batch of cars.

    Attributes:
        cones: [2, K, 2, B] m in the car's frame (x ahead, y left), nearest first, zeros after the last. Fewer slots
            than K where so many are not needed.
        count: [2, B], how many of the K are real.
        real: [K, 2, B], 1 for those, else 0.
        place: [K, 2, B] integers, which candidate each one is.
    """

    cones: Tensor
    count: Tensor
    real: Tensor
    place: Tensor


def to_car(pose: Tensor, points: Tensor) -> Tensor:
    """World points [2, ..., B] m as the car at pose [3, B] sees them (x ahead, y left): [2, ..., B] m."""
    x, y = points[0] - pose[0], points[1] - pose[1]
    cos, sin = pose[2].cos(), pose[2].sin()
    return torch.stack([torch.addcmul(cos * x, sin, y), torch.addcmul(cos * y, sin, x, value=-1)])


def to_world(pose: Tensor, points: Tensor) -> Tensor:
    """The inverse of `to_car`."""
    x, y = points
    cos, sin = pose[2].cos(), pose[2].sin()
    return torch.stack([torch.addcmul(cos * x, sin, y, value=-1) + pose[0], torch.addcmul(cos * y, sin, x) + pose[1]])


def polar(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Distance and angle from the x axis in rad, as `hypot` and `atan2` have them, but for 0 at the origin.

    On a CPU those two round differently at the end of a tensor, and a car would depend on how many others there are.
    """
    distance = torch.addcmul(x * x, y, y).sqrt_()
    acute = (y / (distance + x.abs()).clamp_(min=torch.finfo(x.dtype).tiny)).atan_() * 2
    obtuse = torch.full_like(y, math.pi).copysign_(y) - acute
    return distance, torch.lerp(acute, obtuse, x.clone().lt_(0))


def ahead(x: Tensor, square: Tensor, half_field_of_view: float = HALF_FIELD_OF_VIEW) -> Tensor:
    """1 where a point lies within the field of view, else 0.

    Args:
        x: how far ahead of the car it is, m.
        square: of its distance, m^2.
        half_field_of_view: radians to either side, at most pi / 2.
    """
    # Not behind the car, so x |x| instead of the square of x.
    return torch.addcmul(square * -(math.cos(half_field_of_view) ** 2), x, x.abs()).ge_(0)


def view(local: Tensor, kept: int, sight: float = SIGHT, half_field_of_view: float = HALF_FIELD_OF_VIEW) -> View:
    """Sort out which cones are in sight: at most `sight` m away and `half_field_of_view` to either side.

    Args:
        local: candidate cones in the car's frame, [2, candidates, 2, B] m.
        kept: K, at most this many a side are kept, the nearest ones.
        sight: m.
        half_field_of_view: radians, at most pi / 2.
    """
    x, y = local
    square = torch.addcmul(x * x, y, y)
    visible = square.clone().le_(sight**2).mul_(ahead(x, square, half_field_of_view))
    count = visible.sum(0).clamp_(max=kept)
    kept = slots_in_use(count, min(kept, len(x)))
    slots = torch.arange(kept, dtype=x.dtype, device=x.device).view(-1, 1, 1)
    real = (count - slots).clamp_(0, 1)
    place = smallest(square, visible, kept)
    cones = local.flatten(1).index_select(1, flat_index(place)).view(2, *place.shape) * real
    return View(cones, count, real, place)


def boundary_samples(cones: Tensor, count: Tensor, fit: Fit) -> Tensor:
    """The estimated boundary: a spline through a side's cones, at equal steps of its parameter.

    Args:
        cones: [2, K, 2, B] m, nearest first.
        count: [2, B].
        fit: the spline (points, count) -> Spline.

    Returns:
        [2, 5, 2, B] m; without meaning where a side has fewer than two cones.
    """
    return fit(cones, count).equidistant(SAMPLES)


def encode(samples: Tensor, known: Tensor, sight: float = SIGHT) -> Tensor:
    """The paper's observation (4.1): each sample as distance and angle, scaled to [-1, 1].

    Args:
        samples: boundary samples in the car's frame, [2, 5, 2, B] m.
        known: [2, B], 1 or 0; a side not known yet reads as zeros.
        sight: m, the distance that becomes 1.

    Returns:
        [B, 20]: r1, theta1, ..., r10, theta10, left side first.
    """
    distance, angle = polar(*samples)
    both = torch.stack([distance * (2 / sight) - 1, angle * (1 / WIDEST_ANGLE)]).clamp_(-1, 1) * known
    return both.permute(2, 1, 0, 3).reshape(-1, known.shape[-1]).t()


def flat_index(place: Tensor) -> Tensor:
    """Rows [K, *batch] of a tensor [N, *batch] as places in it once it is flattened, [K * batch]."""
    columns = place[0].numel()
    column = torch.arange(columns, dtype=place.dtype, device=place.device).view(place.shape[1:])
    return torch.add(column, place, alpha=columns).flatten()
