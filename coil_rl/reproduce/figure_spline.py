"""The smoothing spline of appendix A.2: a boundary from noisy cones, ours beside SciPy's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import make_smoothing_spline

from coil_rl.envs.level_files import shipped_track
from coil_rl.envs.splines import Spline, smoothing_spline
from coil_rl.envs.track import SIDES, Side
from coil_rl.report import markdown_table, write_csv
from coil_rl.reproduce.figure_spline_picture import draw
from coil_rl.reproduce.result import NO_RUNS, Result, Runs

Array = NDArray[np.float64]

FEWEST = 5  # points that SciPy needs
FINE = 400  # points of a curve

COLUMNS = {
    "smoothing": ("λ (m³)", "g"),
    "difference": ("largest difference from SciPy (m)", ".1e"),
    "single": ("in float32 (m)", ".1e"),
    "residual": ("residual sum (m²)", ".4f"),
    "roughness": ("roughness (1/m)", ".4f"),
    "error": ("from the true cones (m)", ".3f"),
}


@dataclass(frozen=True, eq=False)
class Fit:
    """A spline through the noisy points, and SciPy's of the same λ.

    Attributes:
        smoothing: λ, m^3.
        curve: ours at equal steps of the parameter, [P, 2] m.
        scipy: SciPy's there, [P, 2] m.
        bends: the length of our second derivative at each point, [N] 1/m.
        scipy_bends: that of SciPy's, [N] 1/m.
        single: the largest difference from SciPy if ours is fitted in float32, m.
        residual: sum of the squared distances from the points, m^2.
        roughness: integral of the squared second derivative, 1/m.
        error: root of the mean squared distance from where the cones truly are, m.
    """

    smoothing: float
    curve: Array
    scipy: Array
    bends: Array
    scipy_bends: Array
    single: float
    residual: float
    roughness: float
    error: float

    @property
    def difference(self) -> float:
        """The largest distance of the two curves, m."""
        return _farthest(self.curve, self.scipy)


class FigureSpline(Result):
    """Cones of one side, moved by noise, and the smoothing spline through them for several λ.

    Args:
        track: a shipped one, by its name.
        side: "left" or "right".
        cones: how many, from the first on.
        noise: m, standard deviation along each axis.
        seed: of the noise.
        smoothings: λ of each curve, m^3.

    Raises:
        ValueError: for a value outside its range, naming it.
    """

    def __init__(
        self,
        track: str = "test_3",
        side: Side = "left",
        cones: int = 16,
        noise: float = 0.25,
        seed: int = 0,
        smoothings: Sequence[float] = (0.0, 0.1, 1.0, 10.0, 100.0),
    ) -> None:
        if side not in SIDES:
            raise ValueError(f"side={side!r} must be one of {', '.join(SIDES)}")
        ring: Array = getattr(shipped_track(track), side)
        if not FEWEST <= cones <= len(ring):
            raise ValueError(f"cones={cones} must be {FEWEST} to {len(ring)}, the {side} cones of {track}")
        if not 0 <= noise < math.inf or seed < 0:
            raise ValueError(f"noise={noise} must be a finite number of at least 0, and seed={seed} at least 0")
        if not smoothings or len(set(smoothings)) < len(smoothings):
            raise ValueError(f"smoothings={list(smoothings)} must be one number or several, none of them twice")
        for smoothing in smoothings:
            if not 0 <= smoothing < math.inf:
                raise ValueError(f"smoothings holds {smoothing}; each must be a finite number of at least 0")
        self.points_are = f"{cones} cones of {track}, {side}, with {noise:g} m of noise"
        self.cones = ring[:cones]
        self.points = self.cones + np.random.default_rng(seed).normal(0, noise, self.cones.shape)
        self.smoothings = [float(smoothing) for smoothing in smoothings]

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        fits = [fit(self.points, self.cones, smoothing) for smoothing in self.smoothings]
        points = [
            {"curve": name, "x": x, "y": y}
            for name, places in (("true cone", self.cones), ("noisy cone", self.points))
            for x, y in places
        ]
        curves = [
            {"curve": "ours", "smoothing": one.smoothing, "x": x, "y": y, "scipy_x": scipy_x, "scipy_y": scipy_y}
            for one in fits
            for (x, y), (scipy_x, scipy_y) in zip(one.curve, one.scipy, strict=True)
        ]
        table = [{key: getattr(one, key) for key in COLUMNS} for one in fits]
        write_csv([*({"curve": "fit"} | row for row in table), *points, *curves], stem.with_suffix(".csv"))
        title = "The smoothing spline for several λ, and SciPy's"
        draw(fits, self.points, self.cones, stem.with_suffix(".png"), title)
        parts = [
            "## The smoothing spline of appendix A.2",
            f"The points are {self.points_are} along each axis. The spline minimises the residual sum "
            "Σ |yᵢ - f(uᵢ)|² plus λ times the roughness ∫ |f''|² du, u the chord length from point to point; SciPy's "
            "is `make_smoothing_spline(u, y, lam=λ)`.",
            markdown_table(table, COLUMNS),
            "λ = 0 goes through every point. A larger λ pays with distance from the points for a straighter curve; too "
            "large, it cuts the bend: the last column is the root of the mean squared distance from where the cones "
            "are without noise. The car estimates boundaries with λ = 0.1 m³, the guide lays its path with λ = 1 m³.",
        ]
        return "\n\n".join(parts)


def fit(points: Array, truth: Array, smoothing: float) -> Fit:
    """Fit a spline to points [N, 2] m in three ways: ours, ours in float32, SciPy's.

    Args:
        points: in order.
        truth: where they would be without noise, [N, 2] m.
        smoothing: λ, m^3.
    """
    spline, single = (_fitted(points, smoothing, dtype) for dtype in (torch.float64, torch.float32))
    u = spline.knots[:, 0].numpy()
    scipy = make_smoothing_spline(u, points, lam=smoothing)
    steps = np.linspace(0, u[-1], FINE)
    values = _rows(spline.values)
    return Fit(
        smoothing=smoothing,
        curve=_rows(spline.equidistant(FINE)),
        scipy=scipy(steps),
        bends=np.hypot(*spline.bends[..., 0].numpy()),
        scipy_bends=np.hypot(*scipy.derivative(2)(u).T),
        single=_farthest(_rows(single.equidistant(FINE)), scipy(steps)),
        residual=float(((values - points) ** 2).sum()),
        roughness=roughness(spline),
        error=float(np.sqrt(((values - truth) ** 2).sum(1).mean())),
    )


def roughness(spline: Spline) -> float:
    """Integral of the squared second derivative of one cubic spline, 1/m: it is linear from knot to knot."""
    before, after = spline.bends[:, :-1], spline.bends[:, 1:]
    square = (before * before + before * after + after * after).sum(0) / 3
    return float((square * spline.knots.diff(dim=0)).sum())


def _fitted(points: Array, smoothing: float, dtype: torch.dtype) -> Spline:
    return smoothing_spline(torch.tensor(points.T, dtype=dtype).unsqueeze(-1), torch.tensor([len(points)]), smoothing)


def _rows(points: torch.Tensor) -> Array:
    """Points [2, N, 1] as [N, 2]."""
    return points[..., 0].t().double().numpy()


def _farthest(one: Array, other: Array) -> float:
    return float(np.hypot(*(one - other).T).max())
