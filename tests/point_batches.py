"""Batches of points to lay splines through, and what splines are compared by."""

import torch
from torch import Tensor

from coil_rl.envs.splines import Spline

SLOTS = 16


def random_batch(dtype: torch.dtype = torch.float64, batch: int = 37) -> tuple[Tensor, Tensor]:
    """Random walks [2, SLOTS, batch], and how many of their points count [batch]."""
    draw = torch.Generator().manual_seed(3)
    points = torch.randn(2, SLOTS, batch, dtype=dtype, generator=draw).cumsum(1)
    return points, torch.randint(0, SLOTS + 1, (batch,), generator=draw)


def tensors(spline: Spline) -> tuple[Tensor, ...]:
    """What a spline is, and places on it."""
    return spline.knots, spline.values, spline.bends, spline.equidistant(7)
