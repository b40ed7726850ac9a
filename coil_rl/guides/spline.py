"""The paper's safety policy (appendix A.1): steer along the middle of the cones in sight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from coil_rl.envs.constants import constant, flat_index
from coil_rl.envs.sight import field_of_view_margin
from coil_rl.envs.sorting import smallest
from coil_rl.envs.splines import Spline, least_squares_parabola, slots_in_use, smoothing_spline

PAIR_DISTANCE = 4.0
TARGET_REACHED = 0.625
FAR = 1e3  # m


class Plan(NamedTuple):
    """What the guide makes of the cones in sight; all places in m in the car's frame.

    Attributes:
        midpoints: of close left-right pairs, nearest first, [2, M, B].
        pairs: how many of them are real, [B].
        path: the spline through them.
        targets: along the path, [2, T, B]; a shorter path repeats its last.
        square: of their distances, [T, B] m^2.
        barred: 0 for those ahead and not reached, else 1, [T, B].
    """

    midpoints: Tensor
    pairs: Tensor
    path: Spline
    targets: Tensor
    square: Tensor
    barred: Tensor


class SplineGuide(TensorDictModuleBase):
    """A smooth path through the midpoints of left-right pairs of cones, and pursuit of a target on it.

    Reads `cones`, `cone_count` and `steering`, writes `action`: it knows the cones in sight and the steering in force,
    never the map and never its own past.

    Args:
        spline: of the path, "cubic" (smoothing) or "quadratic" (least-squares parabola).
        smoothing: lambda of the cubic smoothing spline, m^3.
        gain: the advice is this fraction of equation 103.
        sharpness: power of the distance in equation 103.
        max_steering: degrees of an action of 1.
        cones: only the nearest so many cones of a side are paired.
        midpoints: room for so many midpoints.
        targets: room for so many targets along the path.
        in_keys: where to read the three.
        out_key: where to write the advice.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> env = ConeTrackEnv(shipped_tracks("test"), num_cars=4)
        >>> env.rollout(5, SplineGuide(), break_when_any_done=False)["action"].shape
        torch.Size([4, 5, 1])
    """

    pure = True
    spacing = 1.0  # m from target to target

    def __init__(
        self,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 1.0,
        gain: float = 1.0,
        sharpness: float = 1.8,
        max_steering: float = 80.0,
        cones: int = 8,
        midpoints: int = 24,
        targets: int = 12,
        in_keys: Sequence[NestedKey] = ("cones", "cone_count", "steering"),
        out_key: NestedKey = "action",
    ) -> None:
        self.in_keys, self.out_keys = list(in_keys), [out_key]
        super().__init__()
        if spline not in ("cubic", "quadratic"):
            raise ValueError(f"spline={spline!r} must be one of cubic, quadratic")
        for name, value, low in (("cones", cones, 1), ("midpoints", midpoints, 2), ("targets", targets, 2)):
            if value < low:
                raise ValueError(f"{name}={value} must be at least {low}")
        for name, number in {"smoothing": smoothing, "sharpness": sharpness}.items():
            if not 0 <= number < math.inf:
                raise ValueError(f"{name}={number} must be a finite number of at least 0")
        if not 0 < max_steering < math.inf or not math.isfinite(gain):
            raise ValueError(f"max_steering={max_steering} must be more than 0 and gain={gain} finite")
        self.fit = least_squares_parabola if spline == "quadratic" else partial(smoothing_spline, smoothing=smoothing)
        self.gain, self.sharpness, self.max_steering = gain, sharpness, max_steering
        self.cones, self.midpoints, self.targets = cones, midpoints, targets

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice."""
        return tensordict.set(self.out_keys[0], self.steer(*(tensordict[key] for key in self.in_keys)))

    def steer(self, cones: Tensor, cone_count: Tensor, steering: Tensor) -> Tensor:
        """Advise a steering.

        Args:
            cones: [B, 2, K, 2] m in the car's frame, nearest first, left side first.
            cone_count: [B, 2].
            steering: [B, 1], the steering in force, kept where there is nothing to steer for.

        Returns:
            [B, 1], fraction of `max_steering`.
        """
        plan = self.plan(cones, cone_count)
        advice = self._pursuit(pick(plan.targets, plan.square, plan.barred))
        return torch.where(plan.barred.amin(0).bool(), steering.squeeze(-1), advice).unsqueeze(-1)

    def plan(self, cones: Tensor, cone_count: Tensor) -> Plan:
        """The path and the targets on it; arguments are those of `steer`."""
        points, count = self._midpoints(cones, cone_count)
        path = self.fit(points, count)
        steps = (path.polyline_length / constant(self.spacing, points)).round_().clamp_(1, self.targets - 1)
        targets = slots_in_use(steps, self.targets - 1) + 1
        x, y = found = path.along((constant(range(targets), points[0]) / steps).clamp_(max=1))
        square = torch.addcmul(x * x, y, y)
        room = torch.minimum(square - constant(TARGET_REACHED**2, square), field_of_view_margin(x, square))
        # One midpoint is no path.
        room = torch.minimum(room, count - constant(2, count))
        return Plan(points, count, path, found, square, room.lt_(constant(0, room)))

    def _pursuit(self, target: Tensor) -> Tensor:
        """Equation 103 for targets [2, B] m that are ahead: [B], fraction of `max_steering`."""
        x, y = target.unbind(0)
        square = torch.addcmul(x * x, y, y).clamp_(min=TARGET_REACHED**2)
        # As exp and log, because a power rounds differently at the end of a tensor, and so does `atan2`.
        sharp = (square.log_() * constant(-self.sharpness / 2, square)).exp_()
        alpha = (y / x.clamp(min=torch.finfo(x.dtype).tiny)).atan_() * constant(180 / math.pi, x)
        beta = (alpha * sharp).atan_() * constant(self.gain * 2 / math.pi, x)
        return beta.clamp_(-abs(self.gain), abs(self.gain))

    def _midpoints(self, cones: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """Midpoints of close left-right pairs, nearest first: [2, M, B] m, and how many there are [B]."""
        near = cones[:, :, : slots_in_use(count, self.cones)].permute(3, 2, 1, 0)
        real = (count.t() - constant(range(near.shape[1]), near[0])).clamp_(0, 1)
        # What is no cone lies apart from everything, so it makes no pair.
        left, right = torch.lerp(constant((-FAR, FAR), near[0, 0]), near, real).unbind(2)
        left, right = left.unsqueeze(2), right.unsqueeze(1)
        apart = (left - right).square_().sum(0).ge_(constant(PAIR_DISTANCE**2, left)).flatten(0, 1)
        middle = (left + right).flatten(1, 2)
        total = (constant(len(apart), apart) - apart.sum(0)).clamp_(max=self.midpoints)
        kept = slots_in_use(total, min(self.midpoints, len(apart)))
        nearest = flat_index(smallest(middle.square().sum(0), apart, kept))
        points = middle.flatten(1).index_select(1, nearest).view(2, kept, -1)
        return points * constant(0.5, points), total


def pick(targets: Tensor, order: Tensor, barred: Tensor) -> Tensor:
    """The first one by order [T, B] of the targets [2, T, B] that are not barred: [2, B]."""
    return targets.flatten(1).index_select(1, flat_index(smallest(order, barred, 1)))
