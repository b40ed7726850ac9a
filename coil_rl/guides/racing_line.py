"""Racing line: pursuit of the farthest target with a clear path to it, which cuts corners."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from coil_rl.envs.splines import slots_in_use
from coil_rl.guides.spline import TARGET_REACHED, SplineGuide, first_point


class RacingLineGuide(SplineGuide):
    """Pure pursuit of the farthest target of `SplineGuide` that the car reaches on a clear arc.

    The arc has `turn` times the curvature of the arc from the car to the target: with more than 1 the car turns in
    early and cuts the corner; it plans again at every step and straightens on the way. An arc is clear if all cones
    nearer than the target are on their own side of it and at least `margin` away. Without a clear arc the target is the
    nearest one.

    Args:
        margin: minimum distance between arc and cones, m; less than `car_length`.
        turn: curvature as a multiple of that of the arc to the target.
        lookahead: maximum distance of the target, m.
        spacing: distance between targets along the path, m.
        spline: this and the following arguments as for `SplineGuide`.
        smoothing: lambda of the cubic smoothing spline, m^3.
        max_steering: steering angle of action 1, degrees, at most 90.
        car_length: m.
        cones: number of nearest cones of each side used for pairs; arcs keep clear of all visible cones.
        midpoints: maximum number of midpoints.
        targets: maximum number of targets along the path.
        in_keys: entries of cones, cone count and steering.
        out_key: entry for the advice.

    Raises:
        ValueError: for a value out of range.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> env = ConeTrackEnv(shipped_tracks("test"), num_cars=4)
        >>> env.rollout(5, RacingLineGuide(), break_when_any_done=False)["action"].shape
        torch.Size([4, 5, 1])
    """

    def __init__(
        self,
        margin: float = 0.6,
        turn: float = 1.4,
        lookahead: float = 7.0,
        spacing: float = 0.5,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 1.0,
        max_steering: float = 80.0,
        car_length: float = 2.0,
        cones: int = 8,
        midpoints: int = 24,
        targets: int = 20,
        in_keys: Sequence[NestedKey] = ("cones", "cone_count", "steering"),
        out_key: NestedKey = "action",
    ) -> None:
        super().__init__(
            spline, smoothing, max_steering=max_steering, cones=cones, midpoints=midpoints, targets=targets,
            in_keys=in_keys, out_key=out_key,
        )  # fmt: skip
        positive = {"turn": turn, "lookahead": lookahead, "spacing": spacing, "car_length": car_length}
        for name, value in positive.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name}={value} must be a finite number of more than 0")
        if not 0 <= margin < car_length:  # the smallest turning radius
            raise ValueError(f"margin={margin} must be at least 0 and less than car_length={car_length}")
        if max_steering > 90:
            raise ValueError(f"max_steering={max_steering} must be at most 90 degrees")
        self.margin, self.turn, self.lookahead = margin, turn, lookahead
        self.spacing, self.car_length = spacing, car_length

    def steer(self, cones: Tensor, cone_count: Tensor, steering: Tensor) -> Tensor:
        """Return the advice; arguments and result as for `SplineGuide.steer`."""
        plan = self.plan(cones, cone_count)
        excluded, square = plan.excluded, plan.squared_distance.clamp(min=TARGET_REACHED**2)
        full = math.radians(self.max_steering)
        sine = (plan.targets[1] / square * (2 * self.turn * self.car_length)).clamp(-math.sin(full), math.sin(full))
        unclear = torch.maximum(excluded, self._blocked(sine / self.car_length, square.sqrt(), cones, cone_count))
        none_clear = unclear.amin(0)
        # The farthest of the clear targets, else the nearest target.
        order = torch.lerp(square.reciprocal(), square, none_clear)
        best = first_point(sine.unsqueeze(0), order, torch.lerp(unclear, excluded, none_clear)).squeeze(0)
        advice = best.asin() / full
        return torch.where(excluded.amin(0).bool(), steering.squeeze(-1), advice).unsqueeze(-1)

    def _blocked(self, curvature: Tensor, distance: Tensor, cones: Tensor, count: Tensor) -> Tensor:
        """Return 1 for arcs too close to a cone or with a target beyond the lookahead, else 0.

        Args:
            curvature: [T, B] 1/m, positive to the left.
            distance: [T, B] m, distance of the targets.
            cones: [B, 2, K, 2] m.
            count: [B, 2].
        """
        x, y = cones[:, :, : slots_in_use(count, cones.shape[2])].permute(3, 2, 1, 0)
        slot = torch.arange(len(x), dtype=x.dtype, device=x.device).view(-1, 1, 1)
        side = torch.tensor([[1.0], [-1.0]], dtype=x.dtype, device=x.device)
        square = torch.addcmul(x * x, y, y)
        # "At least `margin` away on its own side of a circle through the car" is linear in the curvature.
        limit = torch.where(count.t() > slot, (y * side - self.margin) * 2, math.inf)
        slope = (square - self.margin**2) * side
        curvature, reach = curvature.unsqueeze(1).unsqueeze(1), (distance + self.margin).square()
        blocked = torch.gt(curvature * slope, limit).logical_and_(square <= reach.unsqueeze(1).unsqueeze(1))
        return blocked.flatten(1, 2).any(1).logical_or_(distance > self.lookahead).to(distance.dtype)
