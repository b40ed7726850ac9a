"""Perception of the robot (paper 4.2, A.3): from LiDAR scans to cones, and to the observation.

The points of a scan are clustered, and a classifier tells thin cones, thick cones and other things
apart by three features of a cluster. The same code perceives simulated and recorded scans.
"""

import json
import math
from dataclasses import KW_ONLY, dataclass, fields
from importlib import resources
from typing import Annotated, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from coil_rl.envs.robot.clusters import GAP, Clusters, measure, points_of, single_linkage
from coil_rl.envs.sight import SAMPLES, SIGHT, encode_samples
from coil_rl.envs.splines import spline_fit
from coil_rl.ranges import Interval, NonNegative, Positive, SeenCones, checked

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

SCANS_PER_BATCH = 512  # keeps the points in the cache
# m, least plausible distance of a boundary sample, in the scale of the cone world.
MIN_DISTANCE = 0.5
MAX_DISTANCE = 1.1  # greatest plausible distance, as a multiple of the range of view


@dataclass(frozen=True, eq=False)
class ConeClassifier:
    """Support vector machines that tell thin cones, thick cones and other clusters apart.

    Another package trains the machines with scikit-learn; the decision in NumPy is many times
    faster for a few clusters. The kernel is radial, exp(-gamma |a - b|^2), on standardised
    features. Of the two decision values, the first is positive for thick cones and negative for
    thin ones; the second is negative for clusters unlike those of the training.

    Args:
        mean: [F], of the features.
        scale: [F], standard deviation of the features, positive.
        support: [S, F], support vectors, standardised.
        weights: [2, S], of the support vectors in the decision values.
        intercept: [2], of the decision values.
        gamma: of the kernel, positive.

    Raises:
        ValueError: for shapes that do not match, a value that is not finite, and a `scale` or
            `gamma` that is not positive.

    Example:
        >>> from coil_rl.envs import simulated_cone_classifier
        >>> thin, thick, wall = [0.035, 0.01, 0.04], [0.085, 0.03, 0.10], [0.6, 0.1, 0.7]
        >>> simulated_cone_classifier().classify([thin, thick, wall])
        array([ 0,  1, -1])
    """

    mean: Array
    scale: Array
    support: Array
    weights: Array
    intercept: Array
    gamma: float

    def __post_init__(self) -> None:
        for field in fields(self):
            value = np.array(getattr(self, field.name), dtype=np.float64)
            if not np.isfinite(value).all():
                raise ValueError(
                    f"{field.name} of a cone classifier contains a value that is not finite"
                )
            object.__setattr__(self, field.name, value)
        shapes = [list(getattr(self, field.name).shape) for field in fields(self)]
        vectors, features = len(np.atleast_1d(self.support)), len(np.atleast_1d(self.mean))
        if shapes != [[features], [features], [vectors, features], [2, vectors], [2], []]:
            raise ValueError(
                f"shapes {shapes} of a cone classifier must be [F], [F], [S, F], [2, S], [2], []"
            )
        if not (self.scale > 0).all() or not self.gamma > 0:
            raise ValueError("scale and gamma of a cone classifier must be more than 0")

    def decision(self, features: NDArray[np.floating]) -> Array:
        """Return the decision values of both machines [C, 2] for features [C, F]."""
        rows = np.asarray(features, dtype=np.float64).reshape(-1, len(self.mean))
        x = (rows - self.mean) / self.scale
        kernel = (x * x).sum(1)[:, None] + (self.support * self.support).sum(1)
        kernel -= 2 * (x @ self.support.T)
        kernel *= -self.gamma
        np.exp(kernel, out=kernel)
        return np.asarray(kernel @ self.weights.T + self.intercept, dtype=np.float64)

    def classify(self, features: NDArray[np.floating]) -> Integers:
        """Return the class of each cluster: 0 for a thin cone, 1 for a thick one, -1 for no cone.

        Args:
            features: [C, F].

        Returns:
            The classes, [C].
        """
        thick, known = self.decision(features).T
        return np.where(known < 0, -1, thick > 0)


def simulated_cone_classifier() -> ConeClassifier:
    """Return the shipped classifier, trained on simulated scans (`SimulatedLidar`)."""
    file = resources.files("coil_rl.envs.robot") / "simulated_cones.json"
    return ConeClassifier(**json.loads(file.read_text(encoding="utf-8")))


@checked
@dataclass(eq=False)
class Perception:
    """Cones in view from LiDAR scans.

    It clusters the points, classifies the clusters and keeps the cones in range. Thin cones mark
    the left side of the track, thick cones the right side. A cone is at the mean of its points.

    Args:
        classifier: tells thin cones, thick cones and other clusters apart.
        range_min: m, smaller ranges are no return.
        range_max: m, range of view.
        bearing_max: degrees to either side of the heading, at most 180.
        scale: factor from the robot's metres to those of the cone world.
        laser_yaw: degrees, bearing of the LiDAR's 0 in the car's frame, anticlockwise.
        margin: m, points this far beyond `range_max` are clustered too, so that cones there are
            complete.
        gap: m, points closer than this are linked.
        kept_cones: K, the nearest cones kept per side.

    Raises:
        ValueError: for a value outside its range.

    Example:
        >>> from coil_rl.envs import Perception, simulated_cone_classifier
        >>> ranges, angles = np.full((1, 360), np.inf), np.radians(np.arange(360) - 180)
        >>> ranges[0, 200:204] = 0.5
        >>> cones, count = Perception(simulated_cone_classifier())(ranges, angles)
        >>> cones.shape, count
        ((1, 2, 16, 2), array([[1, 0]]))
    """

    classifier: ConeClassifier
    _: KW_ONLY
    range_min: float = 0.15
    range_max: Positive = 1.0
    bearing_max: Annotated[float, Interval(gt=0, le=180)] = 60.0
    scale: Positive = 7.0
    laser_yaw: Annotated[float, Interval(ge=-360, le=360)] = 0.0
    margin: NonNegative = 0.15
    gap: Positive = GAP
    kept_cones: SeenCones = 16

    def __post_init__(self) -> None:
        if not 0 < self.range_min < self.range_max:
            raise ValueError(
                f"range_min={self.range_min} must be above 0, the code for no return, and below "
                "range_max"
            )

    @property
    def sight(self) -> float:
        """Range of view in the scale of the cone world, m."""
        return self.range_max * self.scale

    def __call__(
        self, ranges: NDArray[np.floating], angles: NDArray[np.floating]
    ) -> tuple[Array, Integers]:
        """Return the cones in view of scans.

        Args:
            ranges: [N, P] m, the scans.
            angles: [P] radians, bearings of the beams in the LiDAR's frame.

        Returns:
            Cones [N, 2, K, 2] m times `scale` in the car's frame (x forward, y left), left side
            first, nearest first, padded with zeros; and their number [N, 2].
        """
        ranges = np.asarray(ranges)
        cones, counts = [], []
        for start in range(0, len(ranges) or 1, SCANS_PER_BATCH):
            found, count = self._cones(ranges[start : start + SCANS_PER_BATCH], angles)
            cones.append(found)
            counts.append(count)
        return np.concatenate(cones), np.concatenate(counts)

    def clusters(self, ranges: NDArray[np.floating], angles: NDArray[np.floating]) -> Clusters:
        """Return all clusters of at least two points, in the car's frame, unscaled.

        Args:
            ranges: [N, P] m, the scans.
            angles: radians, bearings of the beams in the LiDAR's frame, [P] or, where each scan has
                its own, [N, P].
        """
        bearings = np.asarray(angles, dtype=np.float64) + math.radians(self.laser_yaw)
        points = points_of(ranges, bearings, self.range_min, self.range_max + self.margin)
        return measure(points, single_linkage(points, self.gap))

    def in_sight(self, clusters: Clusters) -> NDArray[np.bool_]:
        """Return whether the centroid of each cluster is in range and bearing, [C]."""
        x, y = clusters.centroid.T
        near = np.hypot(x, y) <= self.range_max
        return near & (np.abs(np.arctan2(y, x)) <= math.radians(self.bearing_max))

    def rejected(self, ranges: NDArray[np.floating], angles: NDArray[np.floating]) -> float:
        """Return the share of the clusters in sight that are no cones, 0 without any.

        Args:
            ranges: [N, P] m, the scans.
            angles: radians, bearings of the beams in the LiDAR's frame, [P] or [N, P].
        """
        clusters = self.clusters(ranges, angles)
        kinds = self.classifier.classify(clusters.features[self.in_sight(clusters)])
        return float((kinds < 0).mean()) if len(kinds) else 0.0

    def _cones(
        self, ranges: NDArray[np.floating], angles: NDArray[np.floating]
    ) -> tuple[Array, Integers]:
        clusters = self.clusters(ranges, angles)
        visible = np.flatnonzero(self.in_sight(clusters))
        kind = self.classifier.classify(clusters.features[visible])
        visible, kind = visible[kind >= 0], kind[kind >= 0]
        position, row = clusters.centroid[visible], clusters.scan[visible] * 2 + kind
        order = np.lexsort((np.hypot(*position.T), row))
        position, row = position[order], row[order]
        count = np.bincount(row, minlength=2 * len(ranges))
        rank = np.arange(len(row)) - (np.cumsum(count) - count)[row]
        near = rank < self.kept_cones
        cones = np.zeros((2 * len(ranges), self.kept_cones, 2))
        cones[row[near], rank[near]] = position[near] * self.scale
        kept = np.minimum(count, self.kept_cones)
        return cones.reshape(-1, 2, self.kept_cones, 2), kept.reshape(-1, 2)


class BoundaryMemory(nn.Module):
    """The observation of a robot without a pose: the boundaries in view (paper A.3).

    A side is valid if it has at least two cones and each of the five boundary samples is at a
    plausible distance. Errors of perception last several scans, as a cone stays in the shadow of
    another one; an invalid side keeps its last valid numbers. The state is in buffers.

    Args:
        batch: B, number of robots.
        spline: of the boundary estimate, "cubic" (smoothing) or "quadratic" (least-squares
            parabola).
        smoothing: lambda of the cubic smoothing spline, m^3.
        sight: m in the scale of the cone world, range of view.
    """

    def __init__(
        self,
        batch: int,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        sight: float = SIGHT,
    ) -> None:
        super().__init__()
        self.fit = spline_fit(spline, smoothing)
        self.spline, self.smoothing, self.sight = spline, smoothing, sight
        self.samples: Tensor = nn.Buffer(torch.zeros(2, SAMPLES, 2, batch))
        self.ever_valid: Tensor = nn.Buffer(torch.zeros(2, batch))

    def forward(self, cones: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """Update the memory with the cones in view.

        Args:
            cones: [B, 2, K, 2] m, as `Perception` returns them.
            count: [B, 2], their number.

        Returns:
            The observation [B, 20], zeros for a side that was never valid, and which sides are
            valid now [B, 2].
        """
        return self.remember(*self.estimate(cones, count))

    def estimate(self, cones: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """Return the boundary samples [2, 5, 2, B] m of cones, and which sides are valid [2, B].

        The memory does not take part; the arguments are those of `forward`.
        """
        samples = self.fit(cones.permute(3, 2, 1, 0), count.t()).equidistant(SAMPLES)
        distance = samples.square().sum(0).sqrt()
        plausible = (distance >= MIN_DISTANCE) & (distance <= self.sight * MAX_DISTANCE)
        return samples, (count.t() >= 2) & plausible.all(0)

    def remember(self, samples: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Update the memory with the output of `estimate`; return what `forward` does."""
        self.samples = torch.where(valid, samples, self.samples)
        self.ever_valid = torch.where(valid, torch.ones_like(self.ever_valid), self.ever_valid)
        return encode_samples(self.samples, self.ever_valid, self.sight), valid.t()

    def reset(self, mask: Tensor) -> None:
        """Clear the rows where mask [B] is true."""
        self.samples = self.samples.masked_fill(mask, 0)
        self.ever_valid = self.ever_valid.masked_fill(mask, 0)
