"""Spline guide with a memory: pursuit of targets that it has placed on the way.

This is how the authors' program does it. `SplineGuide` plans anew in every step; here a path is
planned only when a new cone comes into view, and its targets stay where they are. The memory is
entries of the data (see `GuideMemory`), so the guide works for any batch.
"""

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import TensorDictPrimer

from coil_rl.cones.spline import TARGET_REACHED, SplineGuide
from coil_rl.envs.constants import constant
from coil_rl.envs.sight import SIGHT, Frame, field_of_view_margin
from coil_rl.envs.sorting import append, first_come, rows_in_use
from coil_rl.envs.splines import slots_in_use
from coil_rl.ranges import Positive, checked
from coil_rl.transforms.guide_memory import primer_of

TARGETS, CONES = 192, 128  # room for targets, and for the cones of a side
CANDIDATES = 15  # targets of one path, at most
SAME_CONE = 0.5  # m, less than half of the distance between two cones
SAME_COORDINATE = 5e-3  # m; midpoints of the authors' cones are on a grid of 16 mm
NOWHERE = 1e4  # m, coordinates of empty slots


@checked
class SplineMemoryGuide(SplineGuide):
    """Pursuit of remembered targets: the paper's safety policy as in the authors' program.

    See appendix A.1. When a cone that was never seen comes into view, and two of each side are in
    view, the guide places targets on the least-squares parabola through the midpoints of left-right
    pairs, at least 1 m from each other. It steers for the nearest visible target that has not been
    passed. All positions are in the frame of the car at the start of the episode, and the car's own
    follows from `motion`. There is room for 192 targets and 128 cones a side; further ones are not
    remembered.

    Reads `cones`, `cone_count`, `steering`, `motion` and `is_init`, writes `action`. Its memory is
    entries named `path_...`.

    Args:
        oddities: whether to act exactly as the authors' program: the target is that of the step
            before, and without one the steering is 0; passed targets count again only in a circle
            around the first midpoint; midpoints that share a coordinate with a nearer one are
            dropped; the first observation is ignored. By default the target is chosen now, the
            steering is kept without one, and passed targets count again out of sight.
        sight: m, range in which a target is visible.
        gain: factor of the advice of equation 103.

    Raises:
        ValueError: for a value out of range.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl import ConeTrackEnv, GuideActions, shipped_tracks
        >>> env = ConeTrackEnv(shipped_tracks("test"), num_envs=4)
        >>> env = TransformedEnv(env, GuideActions({"memory": SplineMemoryGuide()}))
        >>> env.rollout(5, break_when_any_done=False)["guide_action"].shape
        torch.Size([4, 5, 1, 1])
    """

    cones, midpoints = 16, 64

    def __init__(
        self,
        oddities: bool = False,
        sight: Positive = SIGHT,
        gain: float = 1.0,
        sharpness: float = 1.8,
        max_steering: float = 80.0,
    ) -> None:
        # What a row remembers at the start of an episode.
        self.memory = {
            "path_pose": torch.zeros(3),  # m, m, radians
            "path_targets": torch.full((2, TARGETS), NOWHERE),
            "path_target_count": torch.zeros(1, dtype=torch.int64),
            "path_passed": torch.zeros(TARGETS, dtype=torch.bool),
            # Ever seen: coordinate, side, cone. Half precision is enough to tell cones, and resets
            # cost less.
            "path_cones": torch.full((2, 2, CONES), NOWHERE, dtype=torch.float16),
            "path_cone_count": torch.zeros(2, dtype=torch.int64),
            # At the last step: coordinate, cone, side.
            "path_in_view": torch.full((2, self.cones, 2), NOWHERE),
        }
        if oddities:
            self.memory |= {
                "path_chosen": torch.full((2,), NOWHERE),
                "path_gate": torch.full((2,), NOWHERE),  # middle of the circle
                "path_in_circle": torch.zeros(1, dtype=torch.bool),
            }
        keys = ["cones", "cone_count", "steering", "motion", "is_init", *self.memory]
        super().__init__("quadratic", 1.0, gain, sharpness, max_steering, keys)
        self.out_keys: list[NestedKey] = [*self.out_keys, *(("next", key) for key in self.memory)]
        self.oddities, self.sight = oddities, sight

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Declare the memory."""
        return primer_of(self.memory)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the advice and the memory for the next step."""
        count, dtype = tensordict["cone_count"], tensordict["steering"].dtype
        cones, steering, motion = (
            tensordict[key].float() for key in ("cones", "steering", "motion")
        )
        memory = {key: tensordict[key] for key in self.memory}
        if self.oddities:
            count = count.masked_fill(tensordict["is_init"], 0)
        old = memory["path_pose"].t()
        pose = torch.cat(
            [Frame(old).to_world(motion[:, :2].t()), (old[2] + motion[:, 2]).unsqueeze(0)]
        )
        frame = Frame(pose)
        memory["path_pose"] = pose.t()
        target = self._nearest_unpassed(memory, frame, old[:2])
        if self.oddities:
            target, memory["path_chosen"] = memory["path_chosen"].t(), target.t()
        self._discover(memory, frame, cones, count)
        local = frame.to_car(target)
        square = torch.addcmul(local[0] * local[0], local[1], local[1])
        advised = (square > TARGET_REACHED**2) & (square < self.sight**2)
        without = torch.zeros_like(steering) if self.oddities else steering
        action = torch.where(advised, self.pursuit(local), without.squeeze(-1)).unsqueeze(-1)
        for key, value in memory.items():
            tensordict.set(("next", key), value)
        return tensordict.set(self.out_keys[0], action.to(dtype))

    def _nearest_unpassed(self, memory: dict[str, Tensor], frame: Frame, before: Tensor) -> Tensor:
        """Update which targets are passed, and return the nearest visible one that is not.

        Args:
            memory: by entry; replaced where it changes.
            frame: of the cars now.
            before: position at the last step, [2, B].

        Returns:
            The target [2, B], a place far away where there is none.
        """
        slots = slots_in_use(memory["path_target_count"], TARGETS)
        targets, passed = memory["path_targets"][:, :, :slots], memory["path_passed"][:, :slots]
        position, cos, sin = frame.position, frame.cos.unsqueeze(-1), frame.sines[0].unsqueeze(-1)
        x, y = targets[:, 0] - position[0].unsqueeze(-1), targets[:, 1] - position[1].unsqueeze(-1)
        square = torch.addcmul(x * x, y, y)
        ahead = torch.addcmul(x * cos, y, sin)
        if self.oddities:
            passed = passed & ~memory["path_in_circle"]
            memory["path_in_circle"] = self._in_circle(memory, before)
        else:
            passed = passed & (square < self.sight**2)
        passed = passed | (square <= TARGET_REACHED**2)
        memory["path_passed"] = torch.cat([passed, memory["path_passed"][:, slots:]], 1)
        hidden = passed | (square >= self.sight**2) | (field_of_view_margin(ahead, square) < 0)
        nearest = square.masked_fill(hidden, torch.inf).min(-1)
        index = nearest.indices.view(-1, 1, 1).expand(-1, 2, 1)
        target = targets.gather(2, index).squeeze(-1)
        return torch.where(nearest.values.isinf(), constant(NOWHERE, target), target.t())

    def _in_circle(self, memory: dict[str, Tensor], position: Tensor) -> Tensor:
        """Return whether positions [2, B] are in the circle around the first midpoint, [B, 1]."""
        offset = position - memory["path_gate"].t()
        inside = torch.addcmul(offset[0] * offset[0], offset[1], offset[1]) < TARGET_REACHED**2
        return inside.unsqueeze(-1)

    def _discover(
        self, memory: dict[str, Tensor], frame: Frame, cones: Tensor, count: Tensor
    ) -> None:
        """Remember the cones in view, and place targets in the rows where one was never seen.

        Args:
            memory: by entry; replaced where it changes.
            frame: of the cars.
            cones: [B, 2, K, 2] m in the frame of the car, nearest first, left side first.
            count: [B, 2], number of cones.
        """
        world, appeared = self._look(memory, frame, cones, count)
        rows = rows_in_use(appeared.flatten(0, 1).any(0))
        if not len(rows):
            return
        world, appeared, count = world[..., rows], appeared[..., rows], count[rows]
        seen = memory["path_cones"][rows].permute(1, 3, 2, 0)
        seen_count = memory["path_cone_count"][rows].t()
        known = seen[:, : slots_in_use(seen_count, CONES)].to(world)
        new = appeared & ~_near(world, known, SAME_CONE)
        seen, total = append(seen, seen_count, world.to(seen), new)
        plans = (total > seen_count).any(0) & (count > 1).all(-1)
        memory["path_cones"] = memory["path_cones"].index_copy(0, rows, seen.permute(3, 0, 2, 1))
        memory["path_cone_count"] = memory["path_cone_count"].index_copy(0, rows, total.t())
        if self.oddities:
            # The middle of the circle is the first midpoint of the first path.
            gate = memory["path_gate"][rows].t()
            gate = torch.where(plans & (gate[0] == NOWHERE), world[:, 0].mean(1), gate)
            memory["path_gate"] = memory["path_gate"].index_copy(0, rows, gate.t())
        frame = Frame(memory["path_pose"][rows].t())
        self._place_targets(memory, frame, rows, plans, cones[rows], count, total[0])

    def _look(
        self, memory: dict[str, Tensor], frame: Frame, cones: Tensor, count: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Remember which cones are in view; the arguments are those of `_discover`.

        Returns:
            The cones [2, K, 2, B] m in the frame of the start, far away in the padding, and which
            of them were not in view in the step before [K, 2, B].
        """
        slots = slots_in_use(count, self.cones)
        real = count.t() > constant(range(slots), count.t().unsqueeze(0))
        local = cones[:, :, :slots].permute(3, 2, 1, 0)
        world = torch.where(real, frame.to_world(local), constant(NOWHERE, local))
        before = memory["path_in_view"].permute(1, 2, 3, 0)
        appeared = real & ~_near(world, before[:, :slots], SAME_CONE)
        empty = constant(NOWHERE, world).expand(2, self.cones - slots, *world.shape[2:])
        memory["path_in_view"] = torch.cat([world, empty], 1).permute(3, 0, 1, 2)
        return world, appeared

    def _place_targets(
        self,
        memory: dict[str, Tensor],
        frame: Frame,
        rows: Tensor,
        plans: Tensor,
        cones: Tensor,
        count: Tensor,
        left: Tensor,
    ) -> None:
        """Place targets on the path through the cones in view.

        Args:
            memory: by entry, of all B rows; replaced where it changes.
            frame: of the cars, for R of the rows as the following.
            rows: their indices, [R].
            plans: [R], whether to place targets.
            cones: [R, 2, K, 2] m in the frame of the car.
            count: [R, 2], number of cones.
            left: [R], number of left cones that were ever seen.
        """
        midpoints, total = self._midpoints(cones, count)
        points, total = frame.to_world(midpoints), total.to(torch.int64)
        if self.oddities:
            points, total = _without_shared(points, total)
        candidates, along = self._candidates(points, total, left)
        targets = memory["path_targets"][rows].permute(1, 2, 0)
        target_count = memory["path_target_count"][rows].t()[0]
        free = ~_near(candidates, targets[:, : slots_in_use(target_count, TARGETS)], self.spacing)
        eligible = free & (along < 1.01) & (plans & (total > 1))
        apart = (candidates.unsqueeze(1) - candidates.unsqueeze(2)).square().sum(0)
        placed = first_come(eligible, apart < self.spacing**2)
        targets, target_count = append(targets, target_count, candidates, placed)
        memory["path_targets"] = memory["path_targets"].index_copy(
            0, rows, targets.permute(2, 0, 1)
        )
        memory["path_target_count"] = memory["path_target_count"].index_copy(
            0, rows, target_count.unsqueeze(-1)
        )

    def _candidates(self, points: Tensor, total: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
        """Return points on a path, and where on the path they are.

        Args:
            points: midpoints of left-right pairs, [2, M, R] m.
            total: [R], number of midpoints.
            left: [R], number of left cones that were ever seen, on which the spacing depends.

        Returns:
            The points [2, C, R] m and their parameters [C, R], from 0 at the first to 1 at the last
            midpoint and beyond.
        """
        first, middle, last = self.fit(points, total).equidistant(3).unsqueeze(2).unbind(1)
        spacings = tuple(0.5 / max(k, 1) ** 0.4 for k in range(CONES + 1))
        u = constant(range(CANDIDATES), points[0]) * constant(spacings, points[0, 0])[left]
        # The parabola through three of its points, which goes on behind the last one.
        candidates = first + u * (last - first + (u - 1) * 2 * (first - 2 * middle + last))
        return candidates, u


def _without_shared(points: Tensor, total: Tensor) -> tuple[Tensor, Tensor]:
    """Drop points that share a coordinate with a nearer one; return the others and their number.

    Args:
        points: [2, M, R] m, nearest first.
        total: [R], number of points.
    """
    real = total > constant(range(points.shape[1]), points[0])
    shared = ((points.unsqueeze(1) - points.unsqueeze(2)).abs() < SAME_COORDINATE).any(0)
    kept = first_come(real, shared)
    return append(torch.zeros_like(points), torch.zeros_like(total), points, kept)


def _near(points: Tensor, others: Tensor, distance: float) -> Tensor:
    """Return which points are near to any of the others, [M, *batch].

    Args:
        points: [2, M, *batch] m.
        others: [2, N, *batch] m.
        distance: m.
    """
    x, y = (points.unsqueeze(2) - others.unsqueeze(1)).unbind(0)
    return torch.addcmul(x * x, y, y).amin(1) < distance**2
