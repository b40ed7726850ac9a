"""Visible cones, boundary estimates and the paper's observation (4.1), for every world with cones.

The batch comes last; the two sides are `[..., 2, B]`, left first.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from coil_rl.envs.constants import constant, flat_index
from coil_rl.envs.sorting import smallest
from coil_rl.envs.splines import slots_in_use

SAMPLES = 5
SIGHT = 7.0  # m
HALF_FIELD_OF_VIEW = math.radians(60)
WIDEST_ANGLE = math.radians(120)


@dataclass(frozen=True)
class View:
    """The visible cones of a batch of cars; K is at most the limit given to `view`, less if no car needs as many."""

    cones: Tensor  # [2, K, 2, B] m in the car's frame (x ahead, y left), nearest first, then zeros
    count: Tensor  # [2, B], number of real cones among the K
    real: Tensor  # [K, 2, B], 1 for a real cone, else 0
    candidate: Tensor  # [K, 2, B], integers, candidate number of each cone
    index: Tensor  # [K * 2 * B], index of each cone in the flattened candidates


class Frame:
    """The coordinate frames of cars at poses [3, B] (m, m, radians): x ahead, y to the left."""

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
    """Return how far points at x m ahead and a squared distance lie within the field of view, in m^2."""
    # x |x| instead of the square of x excludes points behind the car.
    return torch.add(x * x.abs(), square, alpha=-(math.cos(HALF_FIELD_OF_VIEW) ** 2))


def view(local: Tensor, limit: int, sight: float = SIGHT) -> View:
    """Select the visible cones of candidates [2, N, 2, B] m in the car's frame, at most the nearest `limit` a side."""
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
    """Return the paper's observation (4.1), [B, 20]: r1, theta1, ..., r10, theta10, left first, scaled to [-1, 1].

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
    tangent = torch.add(y, distance - x, alpha=1e-30) / (distance + x).clamp_(
        min=torch.finfo(x.dtype).tiny
    )
    both = torch.stack([distance, tangent.atan_()], 2)
    low, scale = constant((-1, 0), known), constant((2 / sight, 2 / WIDEST_ANGLE), known)
    both = torch.addcmul(low, both, scale).clamp_(-1, 1) * known.view(2, 1, 1, -1)
    return both.view(-1, known.shape[-1]).t()
