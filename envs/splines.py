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
from dataclasses import dataclass
from functools import reduce
from itertools import accumulate
from typing import Literal

import torch
from torch import Tensor

from coil_rl.envs.constants import constant, flat_index

__all__ = [
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

    def along(self, share: Tensor) -> Tensor:
        """Evaluate at shares of the length: [S, *batch], from 0 to 1; returns [D, S, *batch], m."""
        return self._at(self.length * share)

    def equidistant(self, samples: int) -> Tensor:
        """Evaluate from first to last point in equal steps of the parameter: [D, samples, *batch], m."""
        ends = self.values[:, :1], self.values[:, -1:]
        if samples <= 2:
            return torch.cat(ends[:samples], 1)
        inner = constant(tuple(k / (samples - 1) for k in range(1, samples - 1)), self.knots)
        return torch.cat([ends[0], self.along(inner), ends[1]], 1)

    def _at(self, u: Tensor) -> Tensor:
        dim, rows = len(self.values), self.knots[0].numel()
        # Strictly below, so that the end of the spline falls into the last real interval, never into padding.
        inner = self.knots.detach()[1:-1].unsqueeze(1)
        below = torch.gt(u.detach(), inner, out=u.new_empty(len(inner), *u.shape))
        start = flat_index(below.sum(0).long())
        ends = torch.add(start, constant((0, rows), start.unsqueeze(0))).flatten()
        x0, x1 = self.knots.flatten().index_select(0, ends).view(2, *u.shape).unbind(0)
        y0, y1 = self.values.flatten(1).index_select(1, ends).view(dim, 2, *u.shape).unbind(1)
        g0, g1 = self.bends.flatten(1).index_select(1, ends).view(dim, 2, *u.shape).unbind(1)

        width, before, after = x1 - x0, u - x0, x1 - u
        # Real intervals are far wider than eps (see _chords); only a spline of one point or none has width 0.
        t = before / width.clamp(min=torch.finfo(u.dtype).eps)
        chord = torch.lerp(y0, y1, t)
        if self.degree == 3:
            return torch.addcmul(chord, before * after, torch.lerp(g0, g1, t) + g0 + g1, value=-1 / 6)
        # Halfway the one end's bend gives way to the other's.
        early, late = (after - before).clamp(min=0).square(), (before - after).clamp(min=0).square()
        sag = torch.addcmul((early - width * after) * g0, late - width * before, g1)
        return torch.add(chord, sag, alpha=1 / 8)


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
    side = per_m * constant(math.sqrt(smoothing), h)
    left, right = side[:-1], side[1:]
    middle, far, span = left + right, left * right, h[:-1] + h[1:]
    # The squares of the three add up to twice this, less its sign.
    squares = torch.addcmul(far, middle, middle, value=-1)
    diagonal = torch.add(span * constant(1 / 3, h), squares, alpha=-2)
    near = torch.addcmul(h[1:-1] * constant(1 / 6, h), side[1:-1], middle[:-1] + middle[1:], value=-1)
    bends = _solve(diagonal, near, far[1:-1], _turns(step, per_m), real[2:-1], span * constant(1 / 4, h))

    # The third derivative of each interval: its jumps at the knots are the pull of the points, Q g.
    jerk = (bends[:, 1:] - bends[:, :-1]) * per_m
    values = points.clone()
    values[:, :-1].sub_(jerk, alpha=smoothing)
    values[:, 1:].add_(jerk, alpha=smoothing)
    return Spline(knots, _hold(values, real), bends, 3)


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
    first, last = torch.cat([h[:1], 0 * h[1:-1]]), h[1:] * (1 - real[3:])
    diagonal = (3 * span + first + last) / 8
    far, turns = torch.zeros_like(h[3:]), _turns(step, h.reciprocal())
    bends = _solve(diagonal, h[1:-1] / 8, far, turns, real[2:-1], span / 4)
    inner = _hold(bends, torch.cat([real[1:], real[-1:]]))
    return Spline(knots, _hold(points, real), torch.cat([inner[:, 1:2], inner[:, 1:]], 1), 2)


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
    known, knots, _, h = _chords(points, count)
    real = known[:-1]
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
    return Spline(knots, _hold(fitted, known), (2 * c2 / scale.square()).expand_as(points), 2)


def slots_in_use(count: Tensor, slots: int) -> int:
    """How many of the slots to look at, for counts [*batch]: at least 2.

    What lies behind is padding and has no influence on a result, so where a look at the data costs nothing (on a CPU,
    outside of compiled code) it need not be computed with.
    """
    if count.device.type != "cpu" or torch.compiler.is_compiling() or not count.numel():
        return slots
    return min(slots, max(2, int(count.max())))


def _total(x: Tensor, dim: int) -> Tensor:
    """Sum in order: `Tensor.sum` adds in an order that depends on the size of the batch."""
    return reduce(torch.add, x.unbind(dim))


def _chords(points: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Which slots are real, 1 or 0 [K+1, *batch], knots [K, *batch], steps [D, K-1, *batch], their lengths, m.

    The last of the K+1 is never real. Lengths have a floor, eps^(1/3) of 1 m and the longest step (1 cm in float32,
    10 um in float64), so that points on one another keep every quotient finite and Q'Q its digits. The floor also
    holds in the padding, where the steps are 0.
    """
    if points.ndim < 2 or points.shape[1] < 2 or points.shape[2:] != count.shape:
        given = f"points {list(points.shape)} and count {list(count.shape)}"
        raise ValueError(f"{given} must be [D, K, *batch] and [*batch], K >= 2")
    real = (count - constant(range(points.shape[1] + 1), points[0])).clamp_(0, 1)
    second = real[1:-1]
    step = (points[:, 1:] - points[:, :-1]) * second
    square = _total(step * step, 0)
    longest = square.amax(0)
    floor = torch.finfo(points.dtype).eps ** (2 / 3)
    h = torch.maximum(square, torch.add(constant(floor, square), longest, alpha=floor)).sqrt()
    travelled = accumulate((h * second).unbind(0), torch.add, initial=torch.zeros_like(longest))
    return real, torch.stack(list(travelled)), step, h


def _turns(step: Tensor, per_m: Tensor) -> Tensor:
    """Change of the chords' slope at each inner point, Q'y: [D, K-2, *batch], at most 2 for any points."""
    slope = step * per_m
    return slope[:, 1:] - slope[:, :-1]


def _hold(x: Tensor, real: Tensor) -> Tensor:
    """Repeat the last real entry of x: [D, K, *batch] in the padding; zeros if there is none. real is [K+1, *batch]."""
    real, last = real[:-1], real[:-1] - real[1:]
    return torch.lerp((x * last).sum(1, keepdim=True), x, real)


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
    nears, fars = list(near.unbind(0)), far.unbind(0)
    lower, lowest, right, inverse = list[Tensor](), list[Tensor](), list[Tensor](), list[Tensor]()
    rows = zip(diagonal.unbind(0), turns.unbind(1), real.unbind(0), least.unbind(0), strict=True)
    for i, (pivot, turn, takes_part, floor) in enumerate(rows):
        if i > 0:
            pivot, turn = _less(pivot, nears[i - 1], lower[i - 1]), _less(turn, lower[i - 1], right[i - 1])
        if i > 1:
            pivot, turn = _less(pivot, fars[i - 2], lowest[i - 2]), _less(turn, lowest[i - 2], right[i - 2])
        # An inverse of 0 takes the unknown out of its own row and, through L, out of all others.
        inverse.append(takes_part / torch.maximum(pivot, floor))
        right.append(turn)
        if 0 < i < len(nears):
            nears[i] = _less(nears[i], lower[i - 1], fars[i - 1])
        if i < len(nears):
            lower.append(nears[i] * inverse[i])
        if i < len(fars):
            lowest.append(fars[i] * inverse[i])
    none = torch.zeros_like(turns.sum(1))
    bends = [none]
    for i in reversed(range(len(right))):
        bend = right[i] * inverse[i]
        if i < len(lower):
            bend = _less(bend, lower[i], bends[-1])
        if i < len(lowest):
            bend = _less(bend, lowest[i], bends[-2])
        bends.append(bend)
    return torch.stack([none, *bends[:0:-1], none], 1)


def _less(x: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return x - a b."""
    return torch.addcmul(x, a, b, value=-1)
