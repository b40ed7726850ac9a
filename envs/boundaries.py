"""The boundary estimate of the cone world: from the cones in sight to the observation."""

from collections.abc import Callable

import torch
from torch import Tensor

from coil_rl.envs.constants import constant
from coil_rl.envs.sight import SAMPLES, Frame, View, encode_samples
from coil_rl.envs.sorting import append, first_come, rows_in_use
from coil_rl.envs.splines import Spline


class Boundaries:
    """Estimates the boundaries of the track ahead of the cars, a curve for each side.

    A side with fewer than two visible cones keeps its last estimate. A held boundary is estimated
    only where a cone came into sight.

    Args:
        fit: fits the curves, see `spline_fit`.
        sight: m, range of view.
        hold: whether the estimate stays in place until a cone comes into view. It is then made
            without cones that share their x or y with a nearer one; a side with fewer than two lies
            at the origin.
    """

    def __init__(
        self, fit: Callable[[Tensor, Tensor], Spline], sight: float, *, hold: bool = False
    ) -> None:
        self.fit, self.sight, self.hold = fit, sight, hold

    def observe(
        self,
        frame: Frame,
        visible: View,
        cones: Tensor,
        new: Tensor,
        samples: Tensor,
        sampled: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Estimate the boundaries.

        Args:
            cones: positions of all candidates, [2, N, 2, B] m in world coordinates.
            new: [B], whether a cone of the candidates came into sight.
            samples: last boundary estimate, [2, 5, 2, B] m in world coordinates.
            sampled: [2, B], 1 for a side with an estimate.

        Returns:
            The observation [B, 20], and the new `samples` and `sampled`.
        """
        if self.hold:
            samples = self._held(visible, cones, new, samples)
            sampled = torch.ones_like(sampled)
            return encode_samples(frame.to_car(samples), sampled, self.sight), samples, sampled
        fresh = visible.real[1]
        local = self.fit(visible.cones, visible.count).equidistant(SAMPLES)
        samples = torch.lerp(samples, frame.to_world(local), fresh)
        sampled = torch.maximum(sampled, fresh)
        # A fresh estimate is observed as it was made, without the detour over world coordinates.
        local = torch.lerp(frame.to_car(samples), local, fresh)
        return encode_samples(local, sampled, self.sight), samples, sampled

    def _held(self, visible: View, cones: Tensor, new: Tensor, samples: Tensor) -> Tensor:
        """Estimate held boundaries where a cone came into sight; arguments as for `observe`."""
        rows = rows_in_use(new)
        if not len(rows):
            return samples
        index = visible.index.view(visible.real.shape).index_select(-1, rows)
        chosen = cones.flatten(1).index_select(1, index.flatten()).view(2, *index.shape)
        estimate = self._of_distinct(chosen, visible.count.index_select(1, rows))
        held = samples.index_select(-1, rows)
        estimate = torch.where(new.index_select(0, rows), estimate, held)
        return samples.index_copy(-1, rows, estimate)

    def _of_distinct(self, cones: Tensor, count: Tensor) -> Tensor:
        """Return samples of held boundaries, without cones that share x or y with a nearer one.

        Args:
            cones: visible cones, [2, K, 2, R] m in world coordinates, nearest first.
            count: [2, R], number of real cones.

        Returns:
            Samples in world coordinates, [2, 5, 2, R] m.
        """
        real = count > constant(range(cones.shape[1]), cones[0])
        distinct = first_come(real, (cones.unsqueeze(1) == cones.unsqueeze(2)).any(0))
        none = torch.zeros_like(count, dtype=torch.int64)
        points, count = append(torch.zeros_like(cones), none, cones, distinct)
        return self.fit(points, count).equidistant(SAMPLES) * (count > 1)
