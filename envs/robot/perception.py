"""A LiDAR scan to the cones in sight, as the paper's robot has it (section 4.2, appendix A.3)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.robot.clusters import GAP, Clusters, Points, measure, points_of, single_linkage
from coil_rl.envs.robot.cone_classifier import ConeClassifier

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

AT_ONCE = 512  # scans, so that their points stay in the cache


class Perception:
    """Clusters the points of scans, tells thin cones from thick ones, and keeps those in sight.

    Thin cones are on the left of the track, thick ones on the right. A cluster is where the mean of its points is.

    Args:
        classifier: which clusters are thick.
        range_min: m, what the LiDAR cannot measure below; smaller ranges are codes for no return.
        range_max: m, how far a cone is seen.
        bearing_max: degrees to either side of the heading, in which one is seen.
        scale: distances are multiplied by this, so that the robot's world has the size of the simulation's.
        laser_yaw: degrees, the bearing of the LiDAR's 0 in the car's frame, anticlockwise.
        margin: m, points are kept so far beyond `range_max`, so that a cone there is whole.
        gap: m, points closer than this are one cluster.
        kept_cones: K, at most this many a side are kept, the nearest ones.

    Raises:
        ValueError: for a value outside its range, naming it.

    Example:
        >>> from coil_rl.envs import Perception, simulated_cone_classifier
        >>> ranges = np.full((1, 360), np.inf)
        >>> ranges[0, 200:205] = 0.5
        >>> cones, count = Perception(simulated_cone_classifier())(ranges, np.radians(np.arange(360) - 180))
        >>> cones.shape, count
        ((1, 2, 16, 2), array([[1, 0]]))
    """

    def __init__(
        self,
        classifier: ConeClassifier,
        *,
        range_min: float = 0.15,
        range_max: float = 1.0,
        bearing_max: float = 60.0,
        scale: float = 7.0,
        laser_yaw: float = 0.0,
        margin: float = 0.15,
        gap: float = GAP,
        kept_cones: int = 16,
    ) -> None:
        for name, value in {"range_max": range_max, "scale": scale, "gap": gap, "kept_cones": kept_cones}.items():
            if not 0 < value < math.inf:
                raise ValueError(f"{name}={value} must be a finite number above 0")
        if not 0 < range_min < range_max:
            raise ValueError(
                f"range_min={range_min} must be above 0, for ranges of 0 are no return, and below range_max"
            )
        if not 0 <= margin < math.inf:
            raise ValueError(f"margin={margin} must be a finite number of at least 0")
        if not 0 < bearing_max <= 180 or not math.isfinite(laser_yaw):
            raise ValueError(f"bearing_max={bearing_max} must be in (0, 180] degrees and laser_yaw={laser_yaw} finite")
        self.classifier = classifier
        self.range_min, self.range_max, self.margin, self.gap = range_min, range_max, margin, gap
        self.bearing_max, self.laser_yaw = math.radians(bearing_max), math.radians(laser_yaw)
        self.scale, self.kept_cones = scale, kept_cones

    def __call__(self, ranges: NDArray[np.floating], angles: NDArray[np.floating]) -> tuple[Array, Integers]:
        """The cones in sight.

        Args:
            ranges: [N, P] m, N scans; what is not finite is no return.
            angles: [P] radians in the LiDAR's frame, anticlockwise.

        Returns:
            [N, 2, K, 2] m times `scale` in the car's frame (x ahead, y left), left side first, nearest first, zeros
            after the last; and how many there are, [N, 2].
        """
        ranges = np.asarray(ranges)
        parts = [self._cones(ranges[begin : begin + AT_ONCE], angles) for begin in range(0, len(ranges) or 1, AT_ONCE)]
        return np.concatenate([cones for cones, _ in parts]), np.concatenate([count for _, count in parts])

    def clusters(self, ranges: NDArray[np.floating], angles: NDArray[np.floating]) -> Clusters:
        """All clusters of at least two points, in the car's frame but not scaled, whether they are cones or not."""
        points = self.points(ranges, angles)
        return measure(points, single_linkage(points, self.gap))

    def points(self, ranges: NDArray[np.floating], angles: NDArray[np.floating]) -> Points:
        """What is near enough to be looked at, in the car's frame but not scaled."""
        turned = np.asarray(angles, dtype=np.float64) + self.laser_yaw
        return points_of(ranges, turned, self.range_min, self.range_max + self.margin)

    def in_sight(self, clusters: Clusters) -> NDArray[np.bool_]:
        """Which clusters [C] the car sees, by the mean of their points."""
        x, y = clusters.centroid.T
        return (np.hypot(x, y) <= self.range_max) & (np.abs(np.arctan2(y, x)) <= self.bearing_max)

    def _cones(self, ranges: NDArray[np.floating], angles: NDArray[np.floating]) -> tuple[Array, Integers]:
        clusters = self.clusters(ranges, angles)
        seen = self.in_sight(clusters)
        place, scan = clusters.centroid[seen], clusters.scan[seen]
        side = scan * 2 + self.classifier.thick(clusters.features[seen])
        order = np.lexsort((np.hypot(*place.T), side))
        place, side = place[order], side[order]
        count = np.bincount(side, minlength=2 * len(ranges))
        rank = np.arange(len(side)) - (np.cumsum(count) - count)[side]
        kept = rank < self.kept_cones
        cones = np.zeros((2 * len(ranges), self.kept_cones, 2))
        cones[side[kept], rank[kept]] = place[kept] * self.scale
        return cones.reshape(-1, 2, self.kept_cones, 2), np.minimum(count, self.kept_cones).reshape(-1, 2)
