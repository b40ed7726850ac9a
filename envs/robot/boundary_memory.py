"""The observation of a robot without a pose: what it last saw of a boundary, until it sees one again (A.3)."""

from __future__ import annotations

from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn

from coil_rl.envs.sight import SAMPLES, SIGHT, encode
from coil_rl.envs.splines import quadratic_spline, smoothing_spline


class BoundaryMemory(nn.Module):
    """Makes the 20 numbers of the observation from cones, and holds those of a side while that side is not valid.

    A side is valid if it shows at least two cones and each of the five samples of the boundary through them is
    plausible: neither inside the robot nor beyond what it sees. Perception errs in runs, for a cone stays in the shadow
    of another one for several scans; through a run the last valid numbers of the side stay as they were. The state is
    in buffers.

    Args:
        batch: B.
        spline: of the boundary estimate, "cubic" (smoothing) or "quadratic" (interpolating).
        smoothing: lambda of the cubic smoothing spline, m^3.
        sight: m, as far as cones are seen, in the scale of the simulation.
        nearest: m, a sample nearer than this is not plausible.
        farthest: times `sight`, a sample beyond is not plausible.

    Raises:
        ValueError: for an unknown spline or a value outside its range.

    Example:
        >>> cones = torch.zeros(1, 2, 16, 2)
        >>> cones[0, 0, :2] = torch.tensor([[2.0, 1.0], [4.0, 1.0]])
        >>> observation, valid = BoundaryMemory(1)(cones, torch.tensor([[2, 0]]))
        >>> observation.shape, valid.tolist()
        (torch.Size([1, 20]), [[True, False]])
    """

    samples: Tensor
    known: Tensor

    def __init__(
        self,
        batch: int,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        sight: float = SIGHT,
        nearest: float = 0.5,
        farthest: float = 1.1,
    ) -> None:
        super().__init__()
        if spline not in ("cubic", "quadratic"):
            raise ValueError(f"spline={spline!r} must be one of cubic, quadratic")
        if not 0 <= nearest < sight * farthest:
            raise ValueError(f"nearest={nearest} m must be at least 0 and below {sight * farthest}, sight * farthest")
        self.fit = partial(smoothing_spline, smoothing=smoothing) if spline == "cubic" else quadratic_spline
        self.sight, self.nearest, self.farthest = sight, nearest, farthest
        self.register_buffer("samples", torch.zeros(2, SAMPLES, 2, batch))
        self.register_buffer("known", torch.zeros(2, batch))

    def forward(self, cones: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """Take in what is seen now.

        Args:
            cones: [B, 2, K, 2] m in the car's frame, in the scale of the simulation, nearest first, left side first.
            count: [B, 2].

        Returns:
            The observation [B, 20], a side never valid yet reading as zeros; and which sides are valid now [B, 2].
        """
        return self.remember(*self.estimate(cones, count))

    def estimate(self, cones: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """What cones say by themselves, whatever is remembered; of any batch.

        Args:
            cones: as for `forward`.
            count: as for `forward`.

        Returns:
            The samples of the boundary [2, 5, 2, B] m, and which sides are valid [2, B].
        """
        samples = self.fit(cones.permute(3, 2, 1, 0), count.t()).equidistant(SAMPLES)
        distance = samples.square().sum(0).sqrt()
        plausible = (distance >= self.nearest) & (distance <= self.sight * self.farthest)
        return samples, (count.t() >= 2) & plausible.all(0)

    def remember(self, samples: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Take in what `estimate` made of the cones seen now; returns what `forward` does."""
        self.samples = torch.where(valid, samples, self.samples)
        self.known = torch.where(valid, torch.ones_like(self.known), self.known)
        return encode(self.samples, self.known, self.sight), valid.t()

    def reset(self, mask: Tensor) -> None:
        """Forget what was seen by the rows where mask: [B], bool."""
        self.samples = self.samples.masked_fill(mask, 0)
        self.known = self.known.masked_fill(mask, 0)
