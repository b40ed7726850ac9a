"""Thin cone or thick cone: the decision of a support vector machine, from the numbers it learned.

Training needs scikit-learn and is done elsewhere (`coil_rl.robot`). To ask takes a few lines of NumPy, which are
also many times faster than asking scikit-learn about the few clusters of one scan.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from functools import cached_property
from importlib import resources

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AT_ONCE = 4096  # clusters, so that the kernel matrix stays small


@dataclass(frozen=True, eq=False)
class ConeClassifier:
    """A support vector machine with a radial kernel on standardised features.

    Args:
        mean: [F], of each feature.
        scale: [F], its standard deviation.
        support: [S, F], the support vectors, standardised.
        weights: [S], of each.
        intercept: added to their sum.
        gamma: of the kernel exp(-gamma |a - b|^2).

    Raises:
        ValueError: for shapes that do not fit or numbers that are not finite.

    Example:
        >>> from coil_rl.envs import simulated_cone_classifier
        >>> simulated_cone_classifier().thick([[0.035, 0.01, 0.04], [0.085, 0.03, 0.10]])
        array([False,  True])
    """

    mean: Array
    scale: Array
    support: Array
    weights: Array
    intercept: float
    gamma: float

    def __post_init__(self) -> None:
        for field in fields(self):
            value = np.array(getattr(self, field.name), dtype=np.float64)
            if not np.isfinite(value).all():
                raise ValueError(f"{field.name} of a cone classifier holds a number that is not finite")
            object.__setattr__(self, field.name, value)
        if self.support.ndim != 2:
            raise ValueError(f"support {list(self.support.shape)} must be [S, F]")
        vectors, features = self.support.shape
        shapes = {"mean": (features,), "scale": (features,), "weights": (vectors,), "intercept": (), "gamma": ()}
        for name, shape in shapes.items():
            given = getattr(self, name).shape
            if given != shape:
                raise ValueError(f"{name} {list(given)} must be {list(shape)} for {vectors} vectors of {features}")
        if not (self.scale > 0).all() or not self.gamma > 0:
            raise ValueError("scale and gamma of a cone classifier must be more than 0")

    @cached_property
    def _lengths(self) -> Array:
        """[S], |b|^2 of each support vector, half of what a kernel costs where there are few clusters."""
        return np.asarray((self.support * self.support).sum(1))

    def decision(self, features: NDArray[np.floating]) -> Array:
        """How sure it is that clusters are thick cones: [C, F] to [C], above 0 thick, below thin."""
        given = np.asarray(features, dtype=np.float64)
        parts = [self._decision(given[begin : begin + AT_ONCE]) for begin in range(0, len(given), AT_ONCE)]
        return np.concatenate([np.zeros(0), *parts])

    def thick(self, features: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which clusters are thick cones: [C, F] to [C]."""
        return self.decision(features) > 0

    def _decision(self, features: Array) -> Array:
        x = (features - self.mean) / self.scale
        square = (x * x).sum(1)[:, None] + self._lengths - 2 * (x @ self.support.T)
        return np.asarray(np.exp(-self.gamma * square) @ self.weights + self.intercept, dtype=np.float64)


def simulated_cone_classifier() -> ConeClassifier:
    """The one that comes with the project; it learned from simulated scans (`SimulatedLidar`), not from real ones."""
    text = (resources.files("coil_rl.envs.robot") / "simulated_cones.json").read_text(encoding="utf-8")
    return ConeClassifier(**json.loads(text))
