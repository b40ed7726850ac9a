"""A spline that grows with the points it knows (definition A.2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from coil_rl.envs.constants import constant
from coil_rl.envs.splines import Spline, smoothing_spline


class SelfEvolvingSpline(nn.Module):
    """Smoothing splines that are computed anew whenever points become known (definition A.2).

    The state is in buffers, so `state_dict` holds all of it. A spline taken from `spline` stays as it is when
    points are added.

    Args:
        capacity: number of points kept per row, at least 2; beyond it the oldest go.
        batch_size: shape of the batch, `*batch`.
        smoothing: lambda of `smoothing_spline`, m^3.
        dim: number of coordinates D.
        dtype: floating type of the state.
        device: device of the state.

    Example:
        >>> path = SelfEvolvingSpline(capacity=8, batch_size=1, smoothing=0.1)
        >>> path.add(torch.tensor([[0.0, 1.0], [0.0, 2.0]]).unsqueeze(-1), torch.ones(2, 1, dtype=torch.bool))
        >>> path.query(torch.zeros(1, 1)).flatten()
        tensor([0., 0.])
    """

    points: Tensor
    count: Tensor
    knots: Tensor
    values: Tensor
    bends: Tensor

    def __init__(
        self,
        capacity: int,
        batch_size: int | Sequence[int],
        smoothing: float,
        dim: int = 2,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        if capacity < 2:
            raise ValueError(f"capacity={capacity}: a spline needs room for at least 2 points")
        self.smoothing = smoothing
        batch = (batch_size,) if isinstance(batch_size, int) else tuple(batch_size)
        self.register_buffer("points", torch.zeros(dim, capacity, *batch, dtype=dtype, device=device))
        self.register_buffer("count", torch.zeros(batch, dtype=torch.long, device=device))
        self.register_buffer("knots", torch.zeros_like(self.points[0]))
        self.register_buffer("values", torch.zeros_like(self.points))
        self.register_buffer("bends", torch.zeros_like(self.points))

    @property
    def spline(self) -> Spline:
        """The spline through the points known so far."""
        return Spline(self.knots, self.values, self.bends, 3)

    def query(self, u: Tensor) -> Tensor:
        """Evaluate the current spline at u: [S, *batch], m; returns [D, S, *batch], m."""
        return self.spline.sample(u)

    @torch.no_grad()
    def add(self, points: Tensor, mask: Tensor) -> None:
        """Append the points [D, M, *batch], m, where mask [M, *batch], bool, in order, and fit again."""
        dim, capacity, *batch = self.points.shape
        if points.shape != (dim, len(mask), *batch) or mask.shape[1:] != self.count.shape:
            given = f"points {list(points.shape)} and mask {list(mask.shape)}"
            raise ValueError(f"{given} must be [{dim}, M, *{batch}] and [M, *{batch}]")
        slots = constant(range(capacity), mask, torch.int64)
        known = torch.cat([slots < self.count, mask.bool()])
        place = known.long().cumsum(0)
        surplus = (place[-1] - capacity).clamp(min=0)
        # What is masked out or too old goes to slot 0, which is then cut off.
        place = torch.where(known, place - surplus, 0).clamp(min=0)
        room = self.points.new_zeros(dim, capacity + 1, *batch)
        both = torch.cat([self.points, points.to(room.dtype)], 1)
        self.points = room.scatter(1, place.expand_as(both), both)[:, 1:].contiguous()
        self.count = (self.count + mask.sum(0)).clamp(max=capacity)
        fit = smoothing_spline(self.points, self.count, self.smoothing)
        self.knots, self.values, self.bends = fit.knots, fit.values, fit.bends

    @torch.no_grad()
    def reset(self, mask: Tensor) -> None:
        """Forget all points of the rows where mask: [*batch], bool."""
        for name, state in list(self.named_buffers()):
            setattr(self, name, state.masked_fill(mask, 0))
