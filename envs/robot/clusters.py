"""Clusters of LiDAR points: single linkage over all scans at once, and features of each cluster.

Points closer than a gap are linked, directly or through other points. Neighbours in bearing are
linked first, which leaves a few runs per scan. An object in front splits the surface behind it into
several runs, so pairs of runs are tested too: points closer than the gap differ by at most
arcsin(gap / distance) in bearing. The result equals the connected components of the full distance
matrix.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

GAP = 0.05  # m
TWO_PI = 2 * np.pi
FEATURES = ("width", "depth", "girth")  # see `Clusters`
ROUNDING = 1e-9  # radians, more than the error of a bearing


@dataclass(frozen=True, eq=False)
class Points:
    """M points of several scans, ordered by scan and bearing.

    Attributes:
        scans: number of scans.
        scan: [M], index of the scan of each point.
        beam: [M], index of the point in its scan.
        bearing: [M] radians, from 0 to 2 pi.
        distance: [M] m.
        x: [M] m, along bearing 0.
        y: [M] m, along bearing pi / 2.
    """

    scans: int
    scan: Integers
    beam: Integers
    bearing: Array
    distance: Array
    x: Array
    y: Array


@dataclass(frozen=True, eq=False)
class Clusters:
    """C clusters of points.

    Attributes:
        label: [C], the label of the points.
        scan: [C], index of the scan.
        size: [C], number of points.
        centroid: [C, 2] m, mean point.
        features: [C, 3] m: width (distance from the first to the last point by bearing), depth
            (greatest minus least range) and girth (sum of the distances between neighbours by
            bearing).
    """

    label: Integers
    scan: Integers
    size: Integers
    centroid: Array
    features: Array


def points_of(
    ranges: NDArray[np.floating], angles: NDArray[np.floating], range_min: float, range_max: float
) -> Points:
    """Return the points of scans; NaN and infinity are no points.

    Args:
        ranges: [N, P] m, the scans.
        angles: radians, bearings of the beams in any order, [P] or, where each scan has its own,
            [N, P].
        range_min: m, smaller ranges are no points.
        range_max: m, greater ranges are no points.

    Raises:
        ValueError: for shapes that do not match, and for a bearing that is not finite.
    """
    ranges, angles = np.asarray(ranges), np.asarray(angles, dtype=np.float64)
    if ranges.ndim != 2 or angles.shape not in (ranges.shape, ranges.shape[1:]):
        raise ValueError(
            f"ranges {list(ranges.shape)} and angles {list(angles.shape)} must be [N, P] and [P] "
            "or [N, P], N scans of P beams"
        )
    if not np.isfinite(angles).all():
        raise ValueError(
            "angles contains a value that is not finite; give the bearing of each beam in radians"
        )
    bearings = np.mod(angles, TWO_PI)
    order = np.broadcast_to(np.argsort(bearings, kind="stable"), ranges.shape)
    in_range = (ranges >= range_min) & (ranges <= range_max)
    scan, index = np.nonzero(np.take_along_axis(in_range, order, axis=1))
    beam = order[scan, index]
    distance = ranges[scan, beam].astype(np.float64)
    bearing, cos, sin = (
        np.broadcast_to(values, ranges.shape)[scan, beam]
        for values in (bearings, np.cos(bearings), np.sin(bearings))
    )
    return Points(len(ranges), scan, beam, bearing, distance, distance * cos, distance * sin)


def single_linkage(points: Points, gap: float = GAP) -> Integers:
    """Return the cluster label of each point [M], counted from 0 through all scans.

    Args:
        gap: m, points nearer to each other than this are linked.
    """
    count = len(points.scan)
    if not count:
        return np.zeros(0, dtype=np.int64)
    index = np.arange(count)
    breaks = (points.scan[1:] != points.scan[:-1]) | ~_close(points, index[:-1], index[1:], gap)
    run = np.concatenate([[0], np.cumsum(breaks)])
    run_end = np.append(np.flatnonzero(breaks) + 1, count)[run]
    first, second = _candidate_pairs(points, run_end, gap)
    close = _close(points, first, second, gap)
    return _merge_labels(run, run[first[close]], run[second[close]])


def _candidate_pairs(points: Points, run_end: Integers, gap: float) -> tuple[Integers, Integers]:
    """Return the pairs of points of a scan that may be close although their runs differ.

    Args:
        run_end: [M], index behind the last point of each point's run.
        gap: m.

    Returns:
        Indices of the first and of the second point of each pair.
    """
    index = np.arange(len(points.scan))
    scan_starts = np.searchsorted(points.scan, np.arange(points.scans + 1))
    end = scan_starts[points.scan + 1]
    size = end - scan_starts[points.scan]  # of the scan of each point
    last_bearing, offset = points.bearing + _reach(points.distance, gap), points.scan * (2 * TWO_PI)
    wraps = last_bearing >= TWO_PI
    last = np.searchsorted(
        offset + points.bearing, offset + last_bearing - TWO_PI * wraps, side="right"
    )
    # The candidates of a point are those behind its run and within reach; indices past the scan's
    # end wrap around.
    count = np.maximum(np.minimum(last + wraps * size, index + size) - run_end, 0)
    first = np.repeat(index, count)
    second = np.arange(len(first)) + np.repeat(run_end - np.cumsum(count) + count, count)
    second = np.where(second < end[first], second, second - size[first])
    return first, second


def _reach(distance: Array, gap: float) -> Array:
    """Return the largest difference in bearing to a point closer than `gap` m, in radians.

    Half a circle is enough for points near the sensor, as each pair is within it in one of the two
    directions.
    """
    with np.errstate(divide="ignore"):
        angle = np.arcsin(np.minimum(1, gap / distance))
    return np.where(distance > gap, angle, np.pi) + ROUNDING


def measure(points: Points, label: Integers, min_points: int = 2) -> Clusters:
    """Return the clusters of points with their features.

    Args:
        label: [M], cluster of each point, as `single_linkage` returns it.
        min_points: clusters of fewer points are left out.
    """
    order = np.argsort(label, kind="stable")
    order = order[np.bincount(label)[label[order]] >= min_points]
    if not len(order):
        empty = np.zeros(0, dtype=np.int64)
        return Clusters(empty, empty, empty, np.zeros((0, 2)), np.zeros((0, 3)))
    first, last = _block_bounds(label[order])
    order = _sort_across_zero(points.bearing, order, first, last)
    x, y, distance = points.x[order], points.y[order], points.distance[order]
    size = last - first + 1
    step = np.zeros(len(order))
    step[1:] = np.hypot(x[1:] - x[:-1], y[1:] - y[:-1])
    step[first] = 0
    width = np.hypot(x[last] - x[first], y[last] - y[first])
    depth = np.maximum.reduceat(distance, first) - np.minimum.reduceat(distance, first)
    features = np.stack([width, depth, np.add.reduceat(step, first)], axis=1)
    centroid = np.stack([np.add.reduceat(axis, first) / size for axis in (x, y)], axis=1)
    return Clusters(label[order[first]], points.scan[order[first]], size, centroid, features)


def _merge_labels(label: Integers, first: Integers, second: Integers) -> Integers:
    """Merge the labels of each pair; return the new labels [M], counted from 0."""
    lowest = np.arange(int(label[-1]) + 1)
    while (lowest[first] != lowest[second]).any():
        for low, high in ((first, second), (second, first)):
            np.minimum.at(lowest, lowest[high], lowest[low])
        lowest = lowest[lowest]
    is_root = lowest == np.arange(len(lowest))
    return (np.cumsum(is_root) - 1)[lowest][label]


def _close(points: Points, first: Integers, second: Integers, gap: float) -> NDArray[np.bool_]:
    """Return whether points, by their indices, are nearer to others than `gap` m."""
    x, y = points.x[first] - points.x[second], points.y[first] - points.y[second]
    return np.asarray(x * x + y * y < gap * gap)


def _block_bounds(label: Integers) -> tuple[Integers, Integers]:
    """Return the first and the last index of each block of equal labels."""
    ends = np.flatnonzero(label[1:] != label[:-1])
    return np.append(0, ends + 1), np.append(ends, len(label) - 1)


def _sort_across_zero(bearing: Array, order: Integers, first: Integers, last: Integers) -> Integers:
    """Order the points of clusters that lie across bearing 0.

    Args:
        bearing: [M] radians, of all points.
        order: indices of points, cluster by cluster and ascending in bearing.
        first: [C], place in `order` of the first point of each cluster.
        last: [C], place of its last point.

    Returns:
        The order in which such a cluster starts after its widest gap in bearing.
    """
    # A cluster that spans at most half a circle has its widest gap outside.
    across = np.flatnonzero(bearing[order[last]] - bearing[order[first]] > np.pi)
    if not len(across):
        return order
    size = (last - first + 1)[across]
    end = np.cumsum(size)
    first_own, last_own = end - size, end - 1
    place = np.arange(end[-1]) + np.repeat(first[across] - first_own, size)
    sorted_bearing = bearing[order[place]]
    cluster = np.repeat(np.arange(len(across)), size)
    gap = np.diff(sorted_bearing, prepend=sorted_bearing[0])
    gap[first_own] = TWO_PI - (sorted_bearing[last_own] - sorted_bearing[first_own])
    widest = np.flatnonzero(gap == np.maximum.reduceat(gap, first_own)[cluster])
    start = widest[_block_bounds(cluster[widest])[0]]
    before = np.arange(len(place)) < start[cluster]
    sorted_order = order.copy()
    sorted_order[place] = order[place[np.lexsort((sorted_bearing + TWO_PI * before, cluster))]]
    return sorted_order
