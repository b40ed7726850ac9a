"""Visible cones, boundary estimates and the paper's observation (4.1), for every world with cones.

The worlds differ in where their cones come from: the cone world looks them up in a map, the robot
finds them in its scans. What follows is the same and is here: the frame of the car, which cones are
in sight, and the encoding of the boundaries as observation.

The batch comes last; the two sides are `[..., 2, B]`, left first.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from coil_rl.envs.constants import constant, flat_index
from coil_rl.envs.sorting import smallest
from coil_rl.envs.splines import slots_in_use

SAMPLES = 5  # of each boundary, in the observation
SIGHT = 7.0  # m, range of view
HALF_FIELD_OF_VIEW = math.radians(60)  # to either side of the heading
WIDEST_ANGLE = math.radians(120)  # bearing of a boundary sample that is encoded as 1


@dataclass(frozen=True)
class View:
    """The visible cones of a batch of cars.

    K is at most the limit given to `view`, and less if no car needs as many.

    Attributes:
        cones: [2, K, 2, B] m in the car's frame (x ahead, y left), nearest first, then zeros.
        count: [2, B], number of real cones among the K.
        real: [K, 2, B], 1 for a real cone, else 0.
        candidate: [K, 2, B], integers, candidate number of each cone.
        index: [K * 2 * B], index of each cone in the flattened candidates.
    """

    cones: Tensor
    count: Tensor
    real: Tensor
    candidate: Tensor
    index: Tensor


class Frame:
    """The coordinate frames of cars: x ahead, y to the left.

    Args:
        pose: of the cars, [3, B] (m, m, radians).
    """

    def __init__(self, pose: Tensor) -> None:
        self.position, heading = pose[:2], pose[2]
        self.cos = heading.cos()
        self.sines = heading.sin() * constant((1, -1), self.position)

    def to_car(self, points: Tensor) -> Tensor:
        """Transform world points [2, ..., B] m to the frames of the cars."""
        position, sines = self._broadcast(points)
        offset = points - position
        return torch.addcmul(self.cos * offset, sines, offset.flip(0))

    def to_world(self, points: Tensor) -> Tensor:
        """Invert `to_car`."""
        position, sines = self._broadcast(points)
        return torch.addcmul(self.cos * points, sines, points.flip(0), value=-1) + position

    def _broadcast(self, points: Tensor) -> tuple[Tensor, Tensor]:
        shape = (2, *[1] * (points.ndim - 2), -1)
        return self.position.view(shape), self.sines.view(shape)


def field_of_view_margin(x: Tensor, square: Tensor) -> Tensor:
    """Return how far points lie within the field of view, in m^2; negative outside.

    Args:
        x: m, coordinate ahead of the car.
        square: m^2, squared distance to the car, of the same shape.
    """
    # x |x| instead of the square of x excludes points behind the car.
    return torch.add(x * x.abs(), square, alpha=-(math.cos(HALF_FIELD_OF_VIEW) ** 2))


def view(local: Tensor, limit: int, sight: float = SIGHT) -> View:
    """Select the visible cones, at most the nearest ones of each side.

    Args:
        local: the candidates, [2, N, 2, B] m in the car's frame.
        sight: m, range of view.
    """
    x, y = local.unbind(0)
    square = torch.addcmul(x * x, y, y)
    margin = torch.minimum(constant(sight**2, x) - square, field_of_view_margin(x, square))
    hidden = margin.lt_(constant(0, x))
    count = (constant(len(x), x) - hidden.sum(0)).clamp_(max=limit)
    slots = slots_in_use(count, min(limit, len(x)))
    real = (count - constant(range(slots), x)).clamp_(0, 1)
    candidate = smallest(square, hidden, slots)
    index = flat_index(candidate)
    cones = local.flatten(1).index_select(1, index).view(2, *candidate.shape) * real
    return View(cones, count, real, candidate, index)


def encode_samples(samples: Tensor, known: Tensor, sight: float = SIGHT) -> Tensor:
    """Return the paper's observation (4.1), [B, 20], scaled to [-1, 1].

    It consists of distance and bearing of the boundary samples: r1, theta1, ..., r10, theta10, the
    left side first.

    Args:
        samples: boundary samples in the car's frame, [2, 5, 2, B] m.
        known: [2, B], 1 or 0; a side not estimated yet is encoded as zeros.
        sight: m, encoded as 1.
    """
    x, y = samples.transpose(1, 2).unbind(0)
    distance = torch.addcmul(x * x, y, y).sqrt_()
    # The half-angle formula is exact for angles within the clipping range. `atan2` rounds
    # differently at the end of a tensor. The term of 1e-30 keeps a sample straight behind the car
    # at 180 degrees.
    tiny = torch.finfo(x.dtype).tiny
    tangent = torch.add(y, distance - x, alpha=1e-30) / (distance + x).clamp_(min=tiny)
    both = torch.stack([distance, tangent.atan_()], 2)
    low, scale = constant((-1, 0), known), constant((2 / sight, 2 / WIDEST_ANGLE), known)
    both = torch.addcmul(low, both, scale).clamp_(-1, 1) * known.view(2, 1, 1, -1)
    return both.view(-1, known.shape[-1]).t()
