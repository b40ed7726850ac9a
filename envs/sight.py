"""What a car sees: the cones in view, the boundary estimated from them, and the 20 numbers of the observation.

Shared by every world that shows cones to an agent. The batch comes last; the two sides are `[..., 2, B]`, left first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from coil_rl.envs.constants import constant, flat_index
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
        index: [K * 2 * B], the same in the candidates once they are flattened.
    """

    cones: Tensor
    count: Tensor
    real: Tensor
    place: Tensor
    index: Tensor


class Frame:
    """The coordinates in which cars see the world: x ahead, y to the left.

    Args:
        pose: of the cars, [3, B]: m, m, radians.

    Example:
        >>> frame = Frame(torch.tensor([[1.0], [2.0], [0.0]]))
        >>> frame.to_car(torch.tensor([[1.0], [5.0]])).flatten().tolist()
        [0.0, 3.0]
    """

    def __init__(self, pose: Tensor) -> None:
        self.position, heading = pose[:2], pose[2]
        self.cos = heading.cos()
        self.turn = heading.sin() * constant((1, -1), self.position)

    def to_car(self, points: Tensor) -> Tensor:
        """World points [2, ..., B] m as the cars see them: [2, ..., B] m."""
        position, turn = self._beside(points)
        offset = points - position
        return torch.addcmul(self.cos * offset, turn, offset.flip(0))

    def to_world(self, points: Tensor) -> Tensor:
        """The inverse of `to_car`."""
        position, turn = self._beside(points)
        return torch.addcmul(self.cos * points, turn, points.flip(0), value=-1) + position

    def _beside(self, points: Tensor) -> tuple[Tensor, Tensor]:
        shape = (2, *[1] * (points.ndim - 2), -1)
        return self.position.view(shape), self.turn.view(shape)


def room_ahead(x: Tensor, square: Tensor, half_field_of_view: float = HALF_FIELD_OF_VIEW) -> Tensor:
    """How far within the field of view a point lies, in m^2; less than 0 if it does not.

    Args:
        x: how far ahead of the car it is, m.
        square: of its distance, m^2.
        half_field_of_view: radians to either side, at most pi / 2.
    """
    # Not behind the car, so x |x| instead of the square of x.
    return torch.add(x * x.abs(), square, alpha=-(math.cos(half_field_of_view) ** 2))


def view(local: Tensor, kept: int, sight: float = SIGHT, half_field_of_view: float = HALF_FIELD_OF_VIEW) -> View:
    """Sort out which cones are in sight: at most `sight` m away and `half_field_of_view` to either side.

    Args:
        local: candidate cones in the car's frame, [2, candidates, 2, B] m.
        kept: K, at most this many a side are kept, the nearest ones.
        sight: m.
        half_field_of_view: radians, at most pi / 2.
    """
    x, y = local.unbind(0)
    square = torch.addcmul(x * x, y, y)
    room = torch.minimum(constant(sight**2, x) - square, room_ahead(x, square, half_field_of_view))
    hidden = room.lt_(constant(0, x))
    count = (constant(len(x), x) - hidden.sum(0)).clamp_(max=kept)
    kept = slots_in_use(count, min(kept, len(x)))
    real = (count - constant(range(kept), x)).clamp_(0, 1)
    place = smallest(square, hidden, kept)
    index = flat_index(place)
    cones = local.flatten(1).index_select(1, index).view(2, *place.shape) * real
    return View(cones, count, real, place, index)


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
    x, y = samples.transpose(1, 2).unbind(0)
    distance = torch.addcmul(x * x, y, y).sqrt_()
    # Half the angle by its tangent, which is exact as far as the angle is not clipped. `atan2` would round differently
    # at the end of a tensor. The term of 1e-30 keeps a sample straight behind the car behind it.
    tangent = torch.add(y, distance - x, alpha=1e-30) / (distance + x).clamp_(min=torch.finfo(x.dtype).tiny)
    both = torch.stack([distance, tangent.atan_()], 2)
    low, scale = constant((-1, 0), known), constant((2 / sight, 2 / WIDEST_ANGLE), known)
    both = torch.addcmul(low, both, scale).clamp_(-1, 1) * known.view(2, 1, 1, -1)
    return both.view(-1, known.shape[-1]).t()
