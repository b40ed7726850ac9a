"""From drives to what the classifier learns from, which needs no person, and to what it is measured with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from coil_rl.envs.robot.clusters import measure, points_of, single_linkage
from coil_rl.envs.robot.cone_classifier import ConeClassifier
from coil_rl.envs.robot.lidar import LEAST
from coil_rl.envs.robot.simulated_drives import SimulatedDrive

Array = NDArray[np.float64]
Scans = tuple[NDArray[np.floating], NDArray[np.floating]]  # ranges [N, P] m and the bearings of their beams [P] radians

RANGE = 1.0  # m
MARGIN = 0.15  # m, points are kept so far beyond
RANGES = (LEAST, 0.25, 0.5, 0.75, 1.0)  # m, ends of the classes
VISIBILITIES = (0.0, 0.5, 0.999, 1.0)


@dataclass(frozen=True, eq=False)
class LabelledClusters:
    """Clusters of which it is known which cone they are of.

    Attributes:
        features: [N, 3] m, width, depth, girth.
        thick: [N].
        drive: [N], the place of each one's drive among those given.
        scan: [N], in that drive.
        cone: [N], number of the cone in that drive.
        distance: [N] m, of the cluster's centroid.
        visibility: [N], share of the cone's beams that nothing in front caught.
    """

    features: Array
    thick: NDArray[np.bool_]
    drive: NDArray[np.int64]
    scan: NDArray[np.int64]
    cone: NDArray[np.int64]
    distance: Array
    visibility: Array


@dataclass(frozen=True)
class Share:
    """How many of how many, and the 95 % interval (Wilson) of the share.

    Attributes:
        right: how many.
        total: of how many.
    """

    right: int
    total: int

    @property
    def share(self) -> float:
        """Right of all, NaN of none."""
        return self.right / self.total if self.total else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Of the share, at 95 %; of neighbouring scans it is too narrow, for they err together."""
        if not self.total:
            return float("nan"), float("nan")
        low, high = binomtest(self.right, self.total).proportion_ci(method="wilson")
        return float(low), float(high)


@dataclass(frozen=True, eq=False)
class OneSided:
    """Clusters of drives past cones of one kind, so that all of them are of that kind.

    Attributes:
        features: [N, 3] m, width, depth, girth.
        drive: [N], the place of each one's drive among those given.
    """

    features: Array
    drive: NDArray[np.int64]


def one_sided(drives: Sequence[Scans], every: int = 1) -> OneSided:
    """The clusters within 1 m of drives past the cones of one side alone.

    Args:
        drives: their scans.
        every: of so many scans one is looked at.
    """
    found = []
    for ranges, angles in drives:
        points = points_of(ranges[::every], angles, LEAST, RANGE + MARGIN)
        clusters = measure(points, single_linkage(points))
        found.append(clusters.features[np.hypot(*clusters.centroid.T) <= RANGE])
    return OneSided(np.concatenate(found), np.repeat(np.arange(len(found)), [len(features) for features in found]))


def label_clusters(drives: Sequence[SimulatedDrive], farthest: float = RANGE) -> LabelledClusters:
    """The clusters of drives, by the cone that most of a cluster's points are of; those of strays only are left out.

    Args:
        drives: those whose truth is known, past any sides.
        farthest: m, clusters with a centroid beyond are left out.
    """
    columns: list[list[NDArray[np.generic]]] = []
    for number, drive in enumerate(drives):
        points = points_of(drive.ranges.numpy(), drive.angles.numpy(), LEAST, farthest + MARGIN)
        label = single_linkage(points)
        clusters = measure(points, label)
        cone = majority(label, drive.hit.numpy()[points.scan, points.beam], drive.cones.shape[1])[clusters.label]
        distance = np.hypot(*clusters.centroid.T)
        kept = (distance <= farthest) & (cone >= 0)
        cone, scan = cone[kept], clusters.scan[kept]
        visibility = drive.visibility.numpy()[scan, cone]
        thick, place = drive.thick.numpy()[cone], np.full(len(cone), number)
        columns.append([clusters.features[kept], thick, place, scan, cone, distance[kept], visibility])
    return LabelledClusters(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def accuracy(classifier: ConeClassifier, labelled: LabelledClusters) -> dict[str, Share]:
    """Share of the clusters that are told right: `all`, by range and by visibility of the cone."""
    right = classifier.thick(labelled.features) == labelled.thick
    return _by_class(right, labelled.distance, labelled.visibility)


def recall(classifier: ConeClassifier, drives: Sequence[SimulatedDrive]) -> dict[str, dict[str, Share]]:
    """Share of the cones within 1 m, shadowed ones too, of which there is a cluster told right.

    A cone counts if its surface is within 1 m, not nearer than the LiDAR measures, and at least one beam meets it.

    Returns:
        For `thin` and `thick` cones: `all`, by range to the surface and by visibility.
    """
    labelled = label_clusters(drives, RANGE + MARGIN)
    right = classifier.thick(labelled.features) == labelled.thick
    found: dict[str, list[list[Array]]] = {"thin": [], "thick": []}
    for number, drive in enumerate(drives):
        offset = drive.cones[:, None] - drive.poses[:2, :, 0, None]
        distance = (offset.norm(dim=0) - drive.radius).numpy()
        visibility = drive.visibility.numpy()
        hits = np.zeros(distance.shape, dtype=bool)
        here = (labelled.drive == number) & right
        hits[labelled.scan[here], labelled.cone[here]] = True
        there = (distance > LEAST) & (distance <= RANGE) & (visibility > 0)
        for name, kind in (("thin", False), ("thick", True)):
            of = there & (drive.thick.numpy() == kind)
            found[name].append([hits[of].astype(float), distance[of], visibility[of]])
    return {
        name: _by_class(*(np.concatenate(column) for column in zip(*rows, strict=True))) for name, rows in found.items()
    }


def majority(label: NDArray[np.int64], cone: NDArray[np.int64], cones: int) -> NDArray[np.int64]:
    """The cone that most points of each cluster are of.

    Args:
        label: the cluster of each point, [M].
        cone: the cone of each point, -1 for none, [M].
        cones: how many there are.

    Returns:
        For each cluster by its label the number of a cone, -1 where all its points are of none.
    """
    votes = np.zeros((int(label.max(initial=-1)) + 1, cones + 1), dtype=np.int64)
    np.add.at(votes, (label, cone), 1)
    return np.where(votes[:, :-1].any(1), votes[:, :-1].argmax(1), -1)


def _by_class(right: NDArray[np.generic], distance: Array, visibility: Array) -> dict[str, Share]:
    shares = {"all": Share(int(right.sum()), len(right))}
    for name, value, ends in (("m", distance, RANGES), ("visible", visibility, VISIBILITIES)):
        for low, high in pairwise(ends):
            of = (value > low) & (value <= high)
            shares[f"{low:g}-{high:g} {name}"] = Share(int(right[of].sum()), int(of.sum()))
    return shares
