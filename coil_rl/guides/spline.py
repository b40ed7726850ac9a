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

from coil_rl.envs.sight import ahead, flat_index, polar
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
        targets: along the path, [2, T, B].
        square: of their distances, [T, B] m^2.
        wanted: 1 for those ahead and not reached, else 0, [T, B].
    """

    midpoints: Tensor
    pairs: Tensor
    path: Spline
    targets: Tensor
    square: Tensor
    wanted: Tensor


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
        advice = self._pursuit(pick(plan.targets, plan.square, plan.wanted))
        return torch.where(plan.wanted.amax(0) > 0, advice, steering.squeeze(-1)).unsqueeze(-1)

    def plan(self, cones: Tensor, cone_count: Tensor) -> Plan:
        """The path and the targets on it; arguments are those of `steer`."""
        midpoints, count = self._midpoints(cones, cone_count)
        path = self.fit(midpoints, count)
        steps = (path.polyline_length / self.spacing).round().clamp(1, self.targets - 1)
        targets = slots_in_use(steps + 1, self.targets)
        number = torch.arange(targets, device=steps.device, dtype=steps.dtype).unsqueeze(-1)
        x, y = found = path.sample(path.length * (number / steps).clamp(max=1))
        square = torch.addcmul(x * x, y, y)
        wanted = square.clone().gt_(TARGET_REACHED**2).mul_(ahead(x, square)).mul_((count - 1).clamp(0, 1))
        return Plan(midpoints, count, path, found, square, wanted)

    def _pursuit(self, target: Tensor) -> Tensor:
        """Equation 103 for targets [2, B] m: [B], fraction of `max_steering`."""
        distance, angle = polar(*target)
        # As exp and log, because a power rounds differently at the end of a tensor.
        sharp = (distance.clamp(min=TARGET_REACHED).log() * -self.sharpness).exp()
        advice = (angle * (180 / math.pi) * sharp).atan() * (2 * self.max_steering / math.pi)
        return advice.clamp(-self.max_steering, self.max_steering) * (self.gain / self.max_steering)

    def _midpoints(self, cones: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """Midpoints of close left-right pairs, nearest first: [2, M, B] m, and how many there are [B]."""
        near = cones[:, :, : slots_in_use(count, self.cones)].permute(3, 2, 1, 0)
        slot = torch.arange(near.shape[1], dtype=near.dtype, device=cones.device).view(-1, 1, 1)
        real = (count.t() - slot).clamp_(0, 1)
        # What is no cone lies apart from everything, so it makes no pair.
        apart = torch.tensor([[-FAR], [FAR]], dtype=near.dtype, device=near.device)
        (left_x, right_x), (left_y, right_y) = torch.lerp(apart, near[0], real).unbind(1), near[1].unbind(1)
        left_x, left_y = left_x.unsqueeze(1), left_y.unsqueeze(1)
        gap = torch.addcmul((left_x - right_x).square_(), left_y - right_y, left_y - right_y)
        close = gap.lt_(PAIR_DISTANCE**2).flatten(0, 1)
        x, y = (left_x + right_x).flatten(0, 1), (left_y + right_y).flatten(0, 1)
        total = close.sum(0).clamp_(max=self.midpoints)
        kept = slots_in_use(total, min(self.midpoints, len(x)))
        nearest = flat_index(smallest(torch.addcmul(x * x, y, y), close, kept))
        points = torch.stack([axis.flatten().index_select(0, nearest).view(kept, -1) for axis in (x, y)])
        return points * 0.5, total


def pick(targets: Tensor, order: Tensor, wanted: Tensor) -> Tensor:
    """The first one wanted by order [T, B] of the targets [2, T, B]: [2, B]."""
    return targets.flatten(1).index_select(1, flat_index(smallest(order, wanted, 1)))
