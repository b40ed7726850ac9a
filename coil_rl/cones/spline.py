"""Safety policy of the paper (appendix A.1): pursuit of a spline between the visible cones.

The guide pairs left with right cones, fits a path through the midpoints, and steers for a point on
it by equation 103. All rows of a batch go through the same tensor operations.
"""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.envs.constants import constant, flat_index
from coil_rl.envs.sight import field_of_view_margin
from coil_rl.envs.sorting import smallest
from coil_rl.envs.splines import Spline, slots_in_use, spline_fit
from coil_rl.ranges import Interval, NonNegative, Positive, checked

PAIR_DISTANCE = 4.0  # m, between the two cones of a pair
TARGET_REACHED = 0.625  # m
FAR = 1e3  # m


class PathPlan(NamedTuple):
    """Path through the visible cones, positions in m in the frame of the car.

    Attributes:
        midpoints: [2, M, B], of left-right pairs, nearest first.
        midpoint_count: [B], number of valid midpoints.
        path: through the midpoints.
        targets: [2, T, B], points along the path; a shorter path repeats its last point.
        squared_distance: [T, B] m^2, of the targets.
        excluded: [T, B], 1 for targets that are reached or outside the field of view, else 0.
    """

    midpoints: Tensor
    midpoint_count: Tensor
    path: Spline
    targets: Tensor
    squared_distance: Tensor
    excluded: Tensor

    def nearest_target(self) -> Tensor:
        """Return the nearest target that is not excluded, [2, B]; any target if all are."""
        return first_point(self.targets, self.squared_distance, self.excluded)


@checked
class SplineGuide(TensorDictModuleBase):
    """Pursuit of a smooth path through the midpoints of left-right pairs of cones.

    The target is the nearest point of the path that is ahead and not reached yet. The guide reads
    `cones`, `cone_count` and `steering` of the current step, and writes `action`.

    Args:
        spline: "cubic" (smoothing spline) or "quadratic" (least-squares parabola).
        smoothing: lambda of the cubic smoothing spline, m^3.
        gain: factor of the advice of equation 103; less than 1 is an undertuned guide.
        sharpness: power of the distance in equation 103, at least 0.
        max_steering: steering angle of action 1, degrees.
        in_keys: entries of cones, cone count and steering.
        out_key: entry for the advice.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> env = ConeTrackEnv(shipped_tracks("test"), num_envs=4)
        >>> env.rollout(5, SplineGuide(), break_when_any_done=False)["action"].shape
        torch.Size([4, 5, 1])
    """

    spacing = 1.0  # m between targets
    cones = 8  # nearest ones of each side that make pairs
    midpoints, targets = 24, 12  # at most

    def __init__(
        self,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: NonNegative = 1.0,
        gain: Annotated[float, Interval(ge=-1e6, le=1e6)] = 1.0,
        sharpness: NonNegative = 1.8,
        max_steering: Positive = 80.0,
        in_keys: Sequence[NestedKey] = ("cones", "cone_count", "steering"),
        out_key: NestedKey = "action",
    ) -> None:
        self.in_keys, self.out_keys = list(in_keys), [out_key]
        super().__init__()
        self.fit = spline_fit(spline, smoothing)
        self.gain, self.sharpness, self.max_steering = gain, sharpness, max_steering
        self.compiled: Callable[..., Sequence[Tensor]] | None = None

    def compile_steps(self, compiled: Callable[..., Callable[..., Sequence[Tensor]]]) -> None:
        """Compile the advice for batches of the size of the first one.

        Args:
            compiled: compiles a function from tensors to tensors, see `Compiled`.
        """
        self.compiled = compiled(lambda *entries: [self.steer(*entries)], once=True)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice."""
        entries = [tensordict[key] for key in self.in_keys]
        advice = self.steer(*entries) if self.compiled is None else self.compiled(*entries)[0]
        return tensordict.set(self.out_keys[0], advice)

    def steer(self, cones: Tensor, cone_count: Tensor, steering: Tensor) -> Tensor:
        """Return the advice, [B, 1], as a fraction of `max_steering`.

        Args:
            cones: [B, 2, K, 2] m in the frame of the car, nearest first, left side first.
            cone_count: [B, 2].
            steering: [B, 1], current steering, returned if there is no target.
        """
        plan = self.plan(cones, cone_count)
        advice = self.pursuit(plan.nearest_target())
        return torch.where(plan.excluded.amin(0).bool(), steering.squeeze(-1), advice).unsqueeze(-1)

    def plan(self, cones: Tensor, cone_count: Tensor) -> PathPlan:
        """Return the path and its targets.

        Args:
            cones: [B, 2, K, 2] m in the frame of the car, nearest first, left side first.
            cone_count: [B, 2].
        """
        points, count = self._midpoints(cones, cone_count)
        path = self.fit(points, count)
        steps = (path.polyline_length / constant(self.spacing, points)).round_()
        steps = steps.clamp_(1, self.targets - 1)
        slots = slots_in_use(steps, self.targets - 1) + 1
        x, y = targets = path.along((constant(range(slots), points[0]) / steps).clamp_(max=1))
        square = torch.addcmul(x * x, y, y)
        # Negative for an excluded target; a single midpoint is not a path.
        margin = torch.minimum(
            square - constant(TARGET_REACHED**2, square), field_of_view_margin(x, square)
        )
        margin = torch.minimum(margin, count - constant(2, count))
        return PathPlan(points, count, path, targets, square, margin.lt_(constant(0, margin)))

    def pursuit(self, target: Tensor) -> Tensor:
        """Return equation 103 for targets [2, B] m ahead: [B], fraction of `max_steering`."""
        x, y = target.unbind(0)
        square = torch.addcmul(x * x, y, y).clamp_(min=TARGET_REACHED**2)
        # Powers and `atan2` round differently at the end of a tensor, so exp, log and atan.
        sharp = (square.log_() * constant(-self.sharpness / 2, square)).exp_()
        alpha = (y / x.clamp(min=torch.finfo(x.dtype).tiny)).atan_() * constant(180 / math.pi, x)
        beta = (alpha * sharp).atan_() * constant(self.gain * 2 / math.pi, x)
        return beta.clamp_(-abs(self.gain), abs(self.gain))

    def _midpoints(self, cones: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """Return the midpoints of close left-right pairs, nearest first.

        Args:
            cones: [B, 2, K, 2] m in the frame of the car, nearest first, left side first.
            count: [B, 2], number of cones.

        Returns:
            The midpoints [2, M, B] m and their number [B].
        """
        near = cones[:, :, : slots_in_use(count, self.cones)].permute(3, 2, 1, 0)
        real = (count.t() - constant(range(near.shape[1]), near[0])).clamp_(0, 1)
        # Padding is moved far away, so that it makes no pairs.
        left, right = torch.lerp(constant((-FAR, FAR), near[0, 0]), near, real).unbind(2)
        left, right = left.unsqueeze(2), right.unsqueeze(1)
        apart = (left - right).square_().sum(0).ge_(constant(PAIR_DISTANCE**2, left)).flatten(0, 1)
        doubled = (left + right).flatten(1, 2)
        total = (constant(len(apart), apart) - apart.sum(0)).clamp_(max=self.midpoints)
        slots = slots_in_use(total, min(self.midpoints, len(apart)))
        nearest = flat_index(smallest(doubled.square().sum(0), apart, slots))
        points = doubled.flatten(1).index_select(1, nearest).view(2, slots, -1)
        return points * constant(0.5, points), total


def first_point(points: Tensor, order: Tensor, excluded: Tensor) -> Tensor:
    """Return the first point in an order that is not excluded, [2, B].

    Args:
        points: to choose from, [2, T, B].
        order: [T, B]; the smallest comes first.
        excluded: [T, B], 1 for points to skip, else 0.
    """
    return points.flatten(1).index_select(1, flat_index(smallest(order, excluded, 1)))
