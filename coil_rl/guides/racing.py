"""The racing line: a second planner, which looks as far ahead as the way is clear and cuts corners."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from coil_rl.envs.splines import slots_in_use
from coil_rl.guides.spline import TARGET_REACHED, SplineGuide, pick


class RacingGuide(SplineGuide):
    """Steers for the farthest target to which the way is clear, where `SplineGuide` steers for the nearest one.

    Its way is the arc that the car drives while it holds a steering, in pure pursuit the arc that leads to the target.
    With a `turn` of more than 1 the arc bends more than that: the car heads for the target sooner and cuts the corner,
    and as every step looks anew, it straightens before it gets there. An arc is clear if all cones nearer than the
    target lie on their own side of it and at least `margin` away. If none is clear, the target is the nearest one.

    Args:
        margin: m between the arc and a cone, at least; less than `car_length`.
        turn: curvature, as a multiple of that of the arc to the target.
        lookahead: m to the target, at most.
        spacing: m from target to target along the path.
        spline: of the path, as for `SplineGuide`, like all that follow.
        smoothing: lambda of the cubic smoothing spline, m^3.
        max_steering: degrees of an action of 1, at most 90.
        car_length: m.
        cones: only the nearest so many cones of a side are paired; arcs keep clear of all in sight.
        midpoints: room for so many midpoints.
        targets: room for so many targets along the path.
        in_keys: where to read the cones, how many are real, and the steering.
        out_key: where to write the advice.

    Raises:
        ValueError: for a value outside its range, naming it.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> env = ConeTrackEnv(shipped_tracks("test"), num_cars=4)
        >>> env.rollout(5, RacingGuide(), break_when_any_done=False)["action"].shape
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
        if not 0 <= margin < car_length:  # which no turning radius falls below
            raise ValueError(f"margin={margin} must be at least 0 and less than car_length={car_length}")
        if max_steering > 90:
            raise ValueError(f"max_steering={max_steering} must be at most 90 degrees")
        self.margin, self.turn, self.lookahead = margin, turn, lookahead
        self.spacing, self.car_length = spacing, car_length

    def steer(self, cones: Tensor, cone_count: Tensor, steering: Tensor) -> Tensor:
        """Advise a steering; arguments and result are those of `SplineGuide`."""
        plan = self.plan(cones, cone_count)
        barred, square = plan.barred, plan.square.clamp(min=TARGET_REACHED**2)
        # What the car does at full steering is the sharpest arc.
        full = math.radians(self.max_steering)
        sine = (plan.targets[1] / square * (2 * self.turn * self.car_length)).clamp(-math.sin(full), math.sin(full))
        unclear = torch.maximum(barred, self._barred(sine / self.car_length, square.sqrt(), cones, cone_count))
        none = unclear.amin(0)
        # Farthest first of those that are clear, else nearest first.
        order = torch.lerp(square.reciprocal(), square, none)
        best = pick(sine.unsqueeze(0), order, torch.lerp(unclear, barred, none)).squeeze(0)
        advice = best.asin() / full
        return torch.where(barred.amin(0).bool(), steering.squeeze(-1), advice).unsqueeze(-1)

    def _barred(self, curvature: Tensor, distance: Tensor, cones: Tensor, count: Tensor) -> Tensor:
        """Which arcs do not keep clear of the cones.

        Args:
            curvature: [T, B] 1/m, positive to the left.
            distance: [T, B] m, how far the targets are.
            cones: [B, 2, K, 2] m.
            count: [B, 2].

        Returns:
            [T, B], 1 or 0; 1 as well for a target beyond the lookahead.
        """
        x, y = cones[:, :, : slots_in_use(count, cones.shape[2])].permute(3, 2, 1, 0)
        slot = torch.arange(len(x), dtype=x.dtype, device=x.device).view(-1, 1, 1)
        side = torch.tensor([[1.0], [-1.0]], dtype=x.dtype, device=x.device)
        square = torch.addcmul(x * x, y, y)
        # On its side of a circle through the car and `margin` from it, or farther: linear in the curvature.
        room = torch.where(count.t() > slot, (y * side - self.margin) * 2, math.inf)
        lever = (square - self.margin**2) * side
        bend, reach = (value.unsqueeze(1).unsqueeze(1) for value in (curvature, (distance + self.margin).square()))
        barred = torch.gt(bend * lever, room).logical_and_(square <= reach)
        return barred.flatten(1, 2).any(1).logical_or_(distance > self.lookahead).to(distance.dtype)
