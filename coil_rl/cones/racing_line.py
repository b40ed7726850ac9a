"""Racing line: pursuit of the farthest target with a clear path to it, which cuts corners."""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey
from torch import Tensor

from coil_rl.cones.spline import TARGET_REACHED, SplineGuide, first_point
from coil_rl.envs.splines import slots_in_use
from coil_rl.ranges import Degrees, Positive, checked


@checked
class RacingLineGuide(SplineGuide):
    """Pure pursuit of the farthest target of `SplineGuide` that the car reaches on a clear arc.

    The arc has `turn` times the curvature of the arc from the car to the target: with more than 1
    the car turns in early and cuts the corner; it plans again at every step and straightens on the
    way. An arc is clear if all cones nearer than the target are on their own side of it and at
    least `margin` away. Without a clear arc the target is the nearest one.

    Args:
        margin: minimum distance between arc and cones, m; less than `car_length`.
        turn: curvature as a multiple of that of the arc to the target.
        lookahead: maximum distance of the target, m.
        spacing: distance between targets along the path, m.
        max_steering: steering angle of action 1, degrees, at most 90.
        car_length: distance between the axles, m.
        spline: of the path, "cubic" (smoothing spline) or "quadratic" (least-squares parabola).

    Raises:
        ValueError: for a value out of range.
    """

    targets = 20

    def __init__(
        self,
        margin: float = 0.6,
        turn: Positive = 1.4,
        lookahead: Positive = 7.0,
        spacing: Positive = 0.5,
        max_steering: Degrees = 80.0,
        car_length: Positive = 2.0,
        *,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 1.0,
        in_keys: Sequence[NestedKey] = ("cones", "cone_count", "steering"),
        out_key: NestedKey = "action",
    ) -> None:
        # `gain` and `sharpness` are of equation 103, which the arc replaces.
        super().__init__(
            spline, smoothing, max_steering=max_steering, in_keys=in_keys, out_key=out_key
        )
        if not 0 <= margin < car_length:  # the smallest turning radius
            raise ValueError(
                f"margin={margin} must be at least 0 and less than car_length={car_length}"
            )
        self.margin, self.turn, self.lookahead = margin, turn, lookahead
        self.spacing, self.car_length = spacing, car_length

    def steer(self, cones: Tensor, cone_count: Tensor, steering: Tensor) -> Tensor:
        """Return the advice, [B, 1], as a fraction of `max_steering`.

        Args:
            cones: [B, 2, K, 2] m in the frame of the car, nearest first, left side first.
            cone_count: [B, 2].
            steering: [B, 1], current steering, returned if there is no target.
        """
        plan = self.plan(cones, cone_count)
        excluded, square = plan.excluded, plan.squared_distance.clamp(min=TARGET_REACHED**2)
        full = math.radians(self.max_steering)
        sine = plan.targets[1] / square * (2 * self.turn * self.car_length)
        sine = sine.clamp(-math.sin(full), math.sin(full))
        blocked = self._blocked(sine / self.car_length, square.sqrt(), cones, cone_count)
        unclear = torch.maximum(excluded, blocked)
        none_clear = unclear.amin(0)
        # The farthest of the clear targets, else the nearest target.
        order = torch.lerp(square.reciprocal(), square, none_clear)
        skipped = torch.lerp(unclear, excluded, none_clear)
        best = first_point(sine.unsqueeze(0), order, skipped).squeeze(0)
        advice = best.asin() / full
        return torch.where(excluded.amin(0).bool(), steering.squeeze(-1), advice).unsqueeze(-1)

    def _blocked(self, curvature: Tensor, distance: Tensor, cones: Tensor, count: Tensor) -> Tensor:
        """Return 1 for arcs too close to a cone or with a target too far away, else 0: [T, B].

        Args:
            curvature: of the arcs, [T, B] in 1/m, positive to the left.
            distance: of the targets, [T, B] m.
            cones: [B, 2, K, 2] m in the frame of the car.
            count: [B, 2], number of cones.
        """
        x, y = cones[:, :, : slots_in_use(count, cones.shape[2])].permute(3, 2, 1, 0)
        slot = torch.arange(len(x), dtype=x.dtype, device=x.device).view(-1, 1, 1)
        side = torch.tensor([[1.0], [-1.0]], dtype=x.dtype, device=x.device)
        square = torch.addcmul(x * x, y, y)
        # "At least `margin` away on its own side of a circle through the car" is linear in the
        # curvature.
        limit = torch.where(count.t() > slot, (y * side - self.margin) * 2, math.inf)
        slope = (square - self.margin**2) * side
        curvature, reach = curvature.unsqueeze(1).unsqueeze(1), (distance + self.margin).square()
        near = square <= reach.unsqueeze(1).unsqueeze(1)
        too_close = torch.gt(curvature * slope, limit).logical_and_(near).flatten(1, 2).any(1)
        return too_close.logical_or_(distance > self.lookahead).to(distance.dtype)
