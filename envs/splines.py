"""Parametric splines through padded batches of points (appendix A.2).

The self-evolving spline of definition A.2 is the path of `SplineMemoryGuide`, fitted again when it
sees a new cone. A spline is stored as its positions and second derivatives at its knots, which
determine the curve between two knots. The cubic smoothing spline and the least-squares parabola are
therefore one class with two fits. Both take `points` [D, K, *batch] in m, in order, K >= 2, and
`count` [*batch], the number of real points of each row; other slots may hold any finite number. A
row with two points yields a line, with one a constant, with none zeros.

The batch comes last, so each step of a recursion over the K slots is one contiguous operation for
the whole batch. Sums are taken in slot order and no branch depends on data, so a row's result
depends on its own points only, to the last bit. Masks are numbers 0 and 1, which are much faster
than booleans in PyTorch's CPU kernels.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, reduce
from itertools import accumulate
from typing import Literal

import torch
from torch import Tensor

from coil_rl.envs.constants import constant, flat_index
from coil_rl.ranges import NonNegative, checked


@dataclass(frozen=True)
class Spline:
    """A batch of parametric splines; padding slots repeat the last real entry.

    Attributes:
        knots: [K, *batch] m, chord length up to each point.
        values: [D, K, *batch] m, positions at the knots.
        bends: [D, K, *batch] 1/m, second derivatives at the knots, linear between two of them.
    """

    knots: Tensor
    values: Tensor
    bends: Tensor

    @property
    def polyline_length(self) -> Tensor:
        """Return the length of the polyline through the spline's values: [*batch], m."""
        step = self.values[:, 1:] - self.values[:, :-1]
        return _total(_total(step * step, 0).sqrt(), 0)

    def along(self, fraction: Tensor) -> Tensor:
        """Evaluate at fractions [S, *batch] of the last knot, from 0 to 1: [D, S, *batch], m."""
        u = self.knots[-1] * fraction
        ends, dim = self._interval_ends(u), len(self.values)
        x0, x1 = self.knots.flatten().index_select(0, ends).view(2, *u.shape).unbind(0)
        y0, y1 = self.values.flatten(1).index_select(1, ends).view(dim, 2, *u.shape).unbind(1)
        g0, g1 = self.bends.flatten(1).index_select(1, ends).view(dim, 2, *u.shape).unbind(1)

        width, before, after = x1 - x0, u - x0, x1 - u
        # Real intervals are much wider than eps (see _chords); splines of one point or none have
        # width 0.
        t = before / width.clamp(min=torch.finfo(u.dtype).eps)
        chord = torch.lerp(y0, y1, t)
        return torch.addcmul(chord, before * after, torch.lerp(g0, g1, t) + g0 + g1, value=-1 / 6)

    def equidistant(self, samples: int) -> Tensor:
        """Evaluate from first to last point in equal steps: [D, samples, *batch] m, at least 3."""
        inner = constant(tuple(k / (samples - 1) for k in range(1, samples - 1)), self.knots)
        return torch.cat([self.values[:, :1], self.along(inner), self.values[:, -1:]], 1)

    def _interval_ends(self, u: Tensor) -> Tensor:
        """Return the knots before and after parameters u [S, *batch].

        They are indices into the flattened knots, [2 * S * batch], first all of the knots before.
        """
        rows = self.knots[0].numel()
        # Strict comparison places the end of the spline in the last real interval instead of the
        # padding.
        inner = self.knots.detach()[1:-1].unsqueeze(1)
        below = torch.gt(u.detach(), inner, out=u.new_empty(len(inner), *u.shape))
        start = flat_index(below.sum(0).long())
        return torch.add(start, constant((0, rows), start.unsqueeze(0))).flatten()


@checked
def spline_fit(
    spline: Literal["cubic", "quadratic"], smoothing: NonNegative
) -> Callable[[Tensor, Tensor], Spline]:
    """Return the fit of that name, a function of points and their count.

    Args:
        spline: "cubic" for the smoothing spline, "quadratic" for the least-squares parabola; else a
            `ValueError`.
        smoothing: lambda of the smoothing spline, m^3; the parabola has none.
    """
    if spline == "quadratic":
        return least_squares_parabola
    return partial(smoothing_spline, smoothing=smoothing)


def smoothing_spline(points: Tensor, count: Tensor, smoothing: float) -> Spline:
    """Fit a natural cubic smoothing spline, parametric in chord length (appendix A.2).

    Minimises sum |y_i - f(u_i)|^2 + smoothing * integral |f''|^2 du by Reinsch's system for the
    second derivatives g, (R + smoothing Q'Q) g = Q'y and f = y - smoothing Q g.

    Args:
        points: [D, K, *batch] m, in order, K >= 2.
        count: [*batch], number of real points of each row.
        smoothing: lambda, m^3; 0 interpolates.
    """
    real, knots, step, h = _chords(points, count)
    # In float32 the system of close points is solved with errors that are a hundred times those of
    # the points themselves.
    h, step = h.double(), step.double()
    per_m = h.reciprocal()
    diagonal, near, far, span = _reinsch_matrix(h, per_m, smoothing)
    slope = step * per_m
    turns = slope[:, 1:] - slope[:, :-1]  # at each inner point, Q'y: [D, K-2, *batch], at most 2
    bends = _solve(diagonal, near, far, turns, real[2:-1], span * constant(1 / 4, h))

    # Third derivative of each interval; its jumps at the knots are Q g.
    jerk = (bends[:, 1:] - bends[:, :-1]) * per_m
    values = points.clone()
    values[:, :-1].sub_(jerk, alpha=smoothing)
    values[:, 1:].add_(jerk, alpha=smoothing)
    return Spline(knots, _repeat_last(values, real), bends.to(points.dtype))


def _reinsch_matrix(
    h: Tensor, per_m: Tensor, smoothing: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the diagonals of R + smoothing Q'Q for the intervals between the knots.

    Args:
        h: lengths of the intervals, [K-1, *batch] m.
        per_m: their reciprocals, 1/m.
        smoothing: lambda, m^3.

    Returns:
        The main diagonal [K-2, *batch], the one next to it [K-3, *batch], the one beyond
        [K-4, *batch], and the length of each pair of neighbouring intervals [K-2, *batch] m.
    """
    # R = tridiag(h/6, (h+h)/3, h/6) and the columns of Q are (1/h, -1/h - 1/h', 1/h'), scaled by
    # sqrt(smoothing).
    side = per_m * constant(math.sqrt(smoothing), h)
    left, right = side[:-1], side[1:]
    middle, far, span = left + right, left * right, h[:-1] + h[1:]
    # Minus half the sum of the squares of the three entries of a column.
    squares = torch.addcmul(far, middle, middle, value=-1)
    diagonal = torch.add(span * constant(1 / 3, h), squares, alpha=-2)
    sixth = h[1:-1] * constant(1 / 6, h)
    near = torch.addcmul(sixth, side[1:-1], middle[:-1] + middle[1:], value=-1)
    return diagonal, near, far[1:-1], span


def least_squares_parabola(points: Tensor, count: Tensor) -> Spline:
    """Fit a least-squares parabola, parametric in chord length.

    It is FITPACK's quadratic spline without inner knots. The `values` are the fitted points; all
    `bends` are equal.

    Args:
        points: [D, K, *batch] m, in order, K >= 2.
        count: [*batch], number of real points of each row.
    """
    padded_real, knots, _, h = _chords(points, count)
    real = padded_real[:-1]
    scale = torch.maximum(knots[-1], h[0])
    origin = points[:, :1] * real[0]
    fitted, curvature = _fit_parabola((points - origin) * real, knots / scale, real, count)
    values = _repeat_last(origin + fitted, padded_real)
    return Spline(knots, values, (2 * curvature / scale.square()).expand_as(points))


def _fit_parabola(offset: Tensor, t: Tensor, real: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Fit parabolas by least squares.

    Args:
        offset: values to fit, [D, K, *batch], 0 in the padding.
        t: parameters, [K, *batch], at most 1.
        real: [K, *batch], 1 for a real point, else 0.
        count: [*batch], number of real points.

    Returns:
        The fitted values [D, K, *batch], and the coefficient of t^2 [D, 1, *batch].
    """
    n = count.clamp(min=1).to(t.dtype)
    p1, n1, p2, n2 = _orthogonal_polynomials(t, real, count, n)
    c0 = (_total(offset, 1) / n).unsqueeze(1)
    left = offset - c0
    c1 = (_total(left * p1, 1) / n1).unsqueeze(1)
    c2 = (_total((left - c1 * p1) * p2, 1) / n2).unsqueeze(1)
    return c0 + c1 * p1 + c2 * p2, c2


def _orthogonal_polynomials(
    t: Tensor, real: Tensor, count: Tensor, n: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the polynomials of degree 1 and 2 that are orthogonal on the knots of a parabola.

    With each coefficient fitted to the residual of the previous ones, the least-squares problem is
    well conditioned in float32 too. A polynomial that too few points determine is 0, its norm 1.

    Args:
        t: scaled knots, [K, *batch].
        real: [K, *batch], 1 for a real knot, else 0.
        count: [*batch], number of real knots.
        n: `count` as a real number, at least 1.

    Returns:
        Values at the knots [K, *batch] and squared norm [*batch] of the polynomial of degree 1,
        then those of the polynomial of degree 2.
    """
    two, three = ((count - k).clamp(0, 1).to(t.dtype) for k in (1, 2))
    p1 = (t - _total(t * real, 0) / n) * real
    n1 = _total(p1 * p1, 0) + (1 - two)
    p2 = (p1 * p1 - n1 / n) * real
    p2 = (p2 - _total(p2 * p1, 0) / n1 * p1) * three
    n2 = _total(p2 * p2, 0) + (1 - three)
    return p1, n1, p2, n2


def slots_in_use(count: Tensor, slots: int) -> int:
    """Return the number of slots to compute for counts [*batch], at least 2.

    Padding does not change results, so it is skipped where reading the data is cheap: on a CPU,
    outside compiled code.
    """
    if count.device.type != "cpu" or torch.compiler.is_compiling() or not count.numel():
        return slots
    return min(slots, max(2, int(count.max())))


def _total(x: Tensor, dim: int) -> Tensor:
    """Sum in slot order; the order of `Tensor.sum` depends on the batch size."""
    return reduce(torch.add, x.unbind(dim))


def _chords(points: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return which slots are real, and the chords between neighbouring points.

    The lengths have a floor of eps^(1/3) times 1 m or the longest step (1 cm in float32, 10 um in
    float64), which keeps quotients finite and Q'Q precise for coincident points and in the padding.

    Returns:
        Masks of real slots [K+1, *batch], of which the last one is never real; knots [K, *batch] m;
        steps from each point to the next one [D, K-1, *batch] m; and their lengths [K-1, *batch] m.
    """
    real = (count - constant(range(points.shape[1] + 1), points[0])).clamp_(0, 1)
    second = real[1:-1]
    step = (points[:, 1:] - points[:, :-1]) * second
    square = _total(step * step, 0)
    longest = square.amax(0)
    floor = torch.finfo(points.dtype).eps ** (2 / 3)
    h = torch.maximum(square, torch.add(constant(floor, square), longest, alpha=floor)).sqrt()
    travelled = accumulate((h * second).unbind(0), torch.add, initial=torch.zeros_like(longest))
    return real, torch.stack(list(travelled)), step, h


def _repeat_last(x: Tensor, real: Tensor) -> Tensor:
    """Fill the padding of x [D, K, *batch] with its last real entry; `real` is [K+1, *batch].

    A row without a real entry becomes zeros.
    """
    real, last = real[:-1], real[:-1] - real[1:]
    return torch.lerp((x * last).sum(1, keepdim=True), x, real)


def _solve(
    diagonal: Tensor, near: Tensor, far: Tensor, turns: Tensor, real: Tensor, least: Tensor
) -> Tensor:
    """Solve the symmetric pentadiagonal systems for the second derivatives at the inner points.

    The method is the factorisation L D L', slot by slot.

    Args:
        diagonal: main diagonals, [K-2, *batch].
        near: the diagonals next to them, [K-3, *batch].
        far: the diagonals beyond, [K-4, *batch].
        turns: right-hand sides, [D, K-2, *batch].
        real: [K-2, *batch], 0 for unknowns that are left out and become 0, else 1.
        least: lower bounds of the pivots, [K-2, *batch]. Pivots fall below them only by rounding
            errors of nearly coincident points: those of R alone are at least (h + h') / 4, and Q'Q
            adds to them.

    Returns:
        The second derivatives at all points, [D, K, *batch], zeros at the first and the last one.
    """
    nears, fars = list(near.unbind(0)), far.unbind(0)
    lower, lowest, right, inverse = list[Tensor](), list[Tensor](), list[Tensor](), list[Tensor]()
    rows = zip(diagonal.unbind(0), turns.unbind(1), real.unbind(0), least.unbind(0), strict=True)
    for i, (pivot, turn, is_real, floor) in enumerate(rows):
        if i > 0:
            pivot = _minus_product(pivot, nears[i - 1], lower[i - 1])
            turn = _minus_product(turn, lower[i - 1], right[i - 1])
        if i > 1:
            pivot = _minus_product(pivot, fars[i - 2], lowest[i - 2])
            turn = _minus_product(turn, lowest[i - 2], right[i - 2])
        # An inverse of 0 removes the unknown from its own row and, through L, from all others.
        inverse.append(is_real / torch.maximum(pivot, floor))
        right.append(turn)
        if 0 < i < len(nears):
            nears[i] = _minus_product(nears[i], lower[i - 1], fars[i - 1])
        if i < len(nears):
            lower.append(nears[i] * inverse[i])
        if i < len(fars):
            lowest.append(fars[i] * inverse[i])
    zero = torch.zeros_like(turns.sum(1))
    bends = [zero]
    for i in reversed(range(len(right))):
        bend = right[i] * inverse[i]
        if i < len(lower):
            bend = _minus_product(bend, lower[i], bends[-1])
        if i < len(lowest):
            bend = _minus_product(bend, lowest[i], bends[-2])
        bends.append(bend)
    return torch.stack([zero, *bends[:0:-1], zero], 1)


def _minus_product(x: Tensor, a: Tensor, b: Tensor) -> Tensor:
    return torch.addcmul(x, a, b, value=-1)
