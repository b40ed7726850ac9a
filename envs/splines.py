"""Parametric splines through padded batches of points.

A spline here is what it does at its knots: position (`values`) and second derivative (`bends`). Between two
knots it is the chord plus a correction that the two bends alone decide, so the cubic smoothing spline
(appendix A.2), the quadratic interpolating spline and the least-squares parabola are one class, fitted in
three ways.

The batch comes last (`points: [D, K, *batch]`), so that each step of a recursion over the K slots is one
contiguous operation for the whole batch. Sums over slots are taken in slot order and nothing branches on
data: a row's result depends on its own points only, to the last bit. Masks are numbers 0 and 1, which
PyTorch's CPU kernels handle many times faster than booleans.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import accumulate
from typing import Literal

import torch
from torch import Tensor, nn

__all__ = [
    "SelfEvolvingSpline",
    "Spline",
    "least_squares_parabola",
    "quadratic_spline",
    "slots_in_use",
    "smoothing_spline",
]


@dataclass(frozen=True)
class Spline:
    """A batch of parametric splines; padding slots repeat the last real entry.

    Attributes:
        knots: [K, *batch], m, chord length travelled at each point.
        values: [D, K, *batch], m, the spline at the knots.
        bends: [D, K, *batch], 1/m, its second derivative there.
        degree: 3 if the second derivative is linear between two knots, 2 if it steps halfway.

    Example:
        >>> corner = torch.tensor([[0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]).unsqueeze(-1)
        >>> spline = smoothing_spline(corner, torch.tensor([3]), smoothing=0.1)
        >>> spline.equidistant(5).shape
        torch.Size([2, 5, 1])
    """

    knots: Tensor
    values: Tensor
    bends: Tensor
    degree: Literal[2, 3]

    @property
    def length(self) -> Tensor:
        """Parameter of the last point: [*batch], m."""
        return self.knots[-1]

    @property
    def polyline_length(self) -> Tensor:
        """How far it is from knot to knot along the spline's values: [*batch], m."""
        step = self.values[:, 1:] - self.values[:, :-1]
        return _total(_total(step * step, 0).sqrt(), 0)

    def sample(self, u: Tensor) -> Tensor:
        """Evaluate at parameters u: [S, *batch], m, clamped to [0, length]; returns [D, S, *batch], m."""
        return self._at(torch.minimum(u.clamp(min=0), self.length))

    def equidistant(self, samples: int) -> Tensor:
        """Evaluate from first to last point in equal steps of the parameter: [D, samples, *batch], m."""
        steps = torch.linspace(0, 1, samples, dtype=self.knots.dtype, device=self.knots.device)
        return self._at(self.length * _column(steps, self.knots))

    def _at(self, u: Tensor) -> Tensor:
        rows = self.knots[0].numel()
        # Strictly below, so that the end of the spline falls into the last real interval, never into padding.
        inner = self.knots.detach()[1:-1].unsqueeze(1)
        below = torch.gt(u.detach(), inner, out=u.new_empty(len(inner), *u.shape))
        row = torch.arange(rows, device=u.device, dtype=torch.int32).view(u.shape[1:])
        start = torch.add(row, below.sum(0).int(), alpha=rows).flatten()
        ends = (start, start + rows)

        dim = len(self.values)
        x0, x1 = (self.knots.flatten().index_select(0, end).view(u.shape) for end in ends)
        y0, y1 = (self.values.flatten(1).index_select(1, end).view(dim, *u.shape) for end in ends)
        g0, g1 = (self.bends.flatten(1).index_select(1, end).view(dim, *u.shape) for end in ends)
        width = x1 - x0
        # Real intervals are far wider than eps (see _chords); only a spline of one point or none has width 0.
        t = (u - x0) / width.clamp(min=torch.finfo(u.dtype).eps)
        s, area = 1 - t, width * width
        chord = torch.addcmul(s * y0, t, y1)
        return torch.addcmul(torch.addcmul(chord, area * self._sag(s), g0), area * self._sag(t), g1)

    def _sag(self, t: Tensor) -> Tensor:
        """Deviation from the chord at fraction t that a bend of 1 at the end t = 1 makes, unit interval."""
        if self.degree == 3:
            return (t * t * t - t) / 6
        return ((2 * t - 1).clamp(min=0).square() - t) / 8


def smoothing_spline(points: Tensor, count: Tensor, smoothing: float) -> Spline:
    """Natural cubic smoothing spline, parametric in chord length (appendix A.2).

    Minimises sum |y_i - f(u_i)|^2 + smoothing * integral |f''|^2 du by Reinsch's system for the bends g,
    (R + smoothing Q'Q) g = Q'y and f = y - smoothing Q g. Two points give their line, one a constant, none
    zeros.

    Args:
        points: [D, K, *batch], m, in order, K >= 2; slots from `count` on may hold any finite number.
        count: [*batch], integer in 0..K, number of real points.
        smoothing: lambda, m^3, at least 0; 0 interpolates.

    Returns:
        The spline, of degree 3, with no bend at its ends.

    Raises:
        ValueError: for shapes that do not fit or a negative `smoothing`.
    """
    if not 0 <= smoothing < math.inf:
        raise ValueError(f"smoothing={smoothing} must be a finite number of at least 0")
    real, knots, step, h = _chords(points, count)
    per_m = h.reciprocal()
    # With R = tridiag(h/6, (h+h)/3, h/6) and Q's columns (1/h, -1/h - 1/h', 1/h'), scaled by sqrt(smoothing):
    side = per_m * math.sqrt(smoothing)
    middle = side[:-1] + side[1:]
    square = side * side
    span = h[:-1] + h[1:]
    diagonal = span / 3 + square[:-1] + square[1:] + middle * middle
    near = h[1:-1] / 6 - side[1:-1] * (middle[:-1] + middle[1:])
    far = side[1:-2] * side[2:-1]
    bends = _solve(diagonal, near, far, _turns(step, per_m), real[2:], span / 4)

    # The third derivative of each interval: its jumps at the knots are the pull of the points, Q g.
    jerk = (bends[:, 1:] - bends[:, :-1]) * per_m
    values = points.clone()
    values[:, :-1].sub_(jerk, alpha=smoothing)
    values[:, 1:].add_(jerk, alpha=smoothing)
    return Spline(knots, _hold(values, count, real), bends, 3)


def quadratic_spline(points: Tensor, count: Tensor) -> Spline:
    """Interpolating quadratic spline, parametric in chord length, its pieces meeting halfway between points.

    The same curve as `scipy.interpolate.make_interp_spline(u, y, k=2)` and FITPACK's `splprep(s=0, k=2)`: no
    break in the first and in the last interval. Two points give their line, one a constant, none zeros.

    Args:
        points: [D, K, *batch], m, in order, K >= 2; slots from `count` on may hold any finite number.
        count: [*batch], integer in 0..K, number of real points.

    Returns:
        The spline, of degree 2.

    Raises:
        ValueError: for shapes that do not fit.
    """
    real, knots, step, h = _chords(points, count)
    span = h[:-1] + h[1:]
    # No break in the first and last interval: the outer bend there equals its neighbour and joins its term.
    outside = torch.zeros_like(real[:1])
    first, last = torch.cat([h[:1], 0 * h[1:-1]]), h[1:] * (1 - torch.cat([real[3:], outside]))
    diagonal = (3 * span + first + last) / 8
    far, turns = torch.zeros_like(h[3:]), _turns(step, h.reciprocal())
    bends = _solve(diagonal, h[1:-1] / 8, far, turns, real[2:], span / 4)
    inner = _hold(bends, count - 1, torch.cat([real[1:], outside]))
    return Spline(knots, _hold(points, count, real), torch.cat([inner[:, 1:2], inner[:, 1:]], 1), 2)


def least_squares_parabola(points: Tensor, count: Tensor) -> Spline:
    """Least-squares parabola, parametric in chord length.

    What FITPACK's quadratic smoothing spline is while it needs no inner knot. Two points give their line,
    one a constant, none zeros.

    Args:
        points: [D, K, *batch], m, in order, K >= 2; slots from `count` on may hold any finite number.
        count: [*batch], integer in 0..K, number of real points.

    Returns:
        The parabola, of degree 2, its `values` the fitted points and its `bends` all equal.

    Raises:
        ValueError: for shapes that do not fit.
    """
    real, knots, _, h = _chords(points, count)
    n = count.clamp(min=1).to(points.dtype)
    two, three = ((count - k).clamp(0, 1).to(points.dtype) for k in (1, 2))
    scale = torch.maximum(knots[-1], h[0])
    # Polynomials orthogonal on the knots, each coefficient taken from what the ones before left over: well
    # conditioned in float32 too. A polynomial that the points are too few to determine is 0, its norm 1.
    t = knots / scale
    p1 = (t - _total(t * real, 0) / n) * real
    n1 = _total(p1 * p1, 0) + (1 - two)
    p2 = (p1 * p1 - n1 / n) * real
    p2 = (p2 - _total(p2 * p1, 0) / n1 * p1) * three
    n2 = _total(p2 * p2, 0) + (1 - three)
    origin = points[:, :1] * real[0]
    left = (points - origin) * real
    c0 = (_total(left, 1) / n).unsqueeze(1)
    left = left - c0
    c1 = (_total(left * p1, 1) / n1).unsqueeze(1)
    c2 = (_total((left - c1 * p1) * p2, 1) / n2).unsqueeze(1)
    fitted = origin + (c0 + c1 * p1 + c2 * p2)
    return Spline(knots, _hold(fitted, count, real), (2 * c2 / scale.square()).expand_as(points), 2)


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
        slots = _column(torch.arange(capacity, device=mask.device), mask)
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


def slots_in_use(count: Tensor, slots: int) -> int:
    """How many of the slots to look at, for counts [*batch]: at least 2.

    What lies behind is padding and has no influence on a result, so where a look at the data costs nothing (on a CPU,
    outside of compiled code) it need not be computed with.
    """
    if count.device.type != "cpu" or torch.compiler.is_compiling() or not count.numel():
        return slots
    return min(slots, max(2, int(count.max())))


def _column(x: Tensor, like: Tensor) -> Tensor:
    """View x: [K] so that it broadcasts against like: [any, *batch]."""
    return x.view(-1, *[1] * (like.ndim - 1))


def _total(x: Tensor, dim: int) -> Tensor:
    """Sum in order: `Tensor.sum` adds in an order that depends on the size of the batch."""
    return reduce(torch.add, x.unbind(dim))


def _chords(points: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Which slots are real, 1 or 0 [K, *batch], knots [K, *batch], steps [D, K-1, *batch], their lengths, m.

    Lengths have a floor, eps^(1/3) of 1 m and the longest step (1 cm in float32, 10 um in float64), so that
    points on one another keep every quotient finite and Q'Q its digits. The floor also holds in the padding,
    where the steps are 0.
    """
    if points.ndim < 2 or points.shape[1] < 2 or points.shape[2:] != count.shape:
        given = f"points {list(points.shape)} and count {list(count.shape)}"
        raise ValueError(f"{given} must be [D, K, *batch] and [*batch], K >= 2")
    slots = torch.arange(points.shape[1], dtype=points.dtype, device=points.device)
    real = (count.to(points.dtype) - _column(slots, points[0])).clamp(0, 1)
    step = (points[:, 1:] - points[:, :-1]) * real[1:]
    square = _total(step * step, 0)
    longest = square.amax(0)
    h = torch.maximum(square, (longest + 1) * torch.finfo(points.dtype).eps ** (2 / 3)).sqrt()
    travelled = accumulate((h * real[1:]).unbind(0), torch.add, initial=torch.zeros_like(longest))
    return real, torch.stack(list(travelled)), step, h


def _turns(step: Tensor, per_m: Tensor) -> Tensor:
    """Change of the chords' slope at each inner point, Q'y: [D, K-2, *batch], at most 2 for any points."""
    slope = step * per_m
    return slope[:, 1:] - slope[:, :-1]


def _hold(x: Tensor, count: Tensor, real: Tensor) -> Tensor:
    """Repeat the last real entry of x: [D, K, *batch] in the padding; zeros if there is none."""
    last = (count.long() - 1).clamp(min=0).expand_as(x[:, :1])
    return torch.addcmul((x.gather(1, last) * real[0]) * (1 - real), x, real)


def _solve(diagonal: Tensor, near: Tensor, far: Tensor, turns: Tensor, real: Tensor, least: Tensor) -> Tensor:
    """Solve the symmetric pentadiagonal systems for the bends at the inner points by L D L', slot by slot.

    Args:
        diagonal: [K-2, *batch], main diagonal.
        near: [K-3, *batch], first off-diagonal.
        far: [K-4, *batch], second off-diagonal.
        turns: [D, K-2, *batch], right-hand side.
        real: [K-2, *batch], 1 for the unknowns that take part, 0 for those that are to come out as 0.
        least: [K-2, *batch], what the pivots fall below only by rounding, where points nearly coincide:
            those of R alone are at least (h + h') / 4, and Q'Q adds to them.

    Returns:
        [D, K, *batch], with zeros in the first and the last slot.
    """
    zero, none = torch.zeros_like(least.sum(0)), torch.zeros_like(turns.sum(1))
    fars = [zero, zero, *far.unbind(0), zero, zero]
    nears = [*near.unbind(0), zero]
    # Entry -1 belongs to the slot before, -2 to the one before that. Zeros stand in for what is not there.
    upper, lower, lowest, right, inverse = zero, [zero], [zero, zero], [none, none], []
    for i, (pivot, turn) in enumerate(zip(diagonal.unbind(0), turns.unbind(1), strict=True)):
        pivot = _less(_less(pivot, upper, lower[-1]), fars[i], lowest[-2])
        turn = _less(_less(turn, lower[-1], right[-1]), lowest[-2], right[-2])
        upper = _less(nears[i], lower[-1], fars[i + 1])
        # An inverse of 0 takes the unknown out of its own row and, through L, out of all others.
        inverse.append(real[i] / torch.maximum(pivot, least[i]))
        lower.append(upper * inverse[-1])
        lowest.append(fars[i + 2] * inverse[-1])
        right.append(turn)
    bends = [none, none]
    for turn, factor, one, two in zip(right[:1:-1], inverse[::-1], lower[:0:-1], lowest[:1:-1], strict=True):
        bends.append(_less(_less(turn * factor, one, bends[-1]), two, bends[-2]))
    return torch.stack([none, *bends[:0:-1]], 1)


def _less(x: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return x - a b."""
    return torch.addcmul(x, a, b, value=-1)
