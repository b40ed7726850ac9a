"""LiDAR scans to clusters: single linkage around the whole turn, and what a cluster measures.

Two points belong together if they are closer than a gap, directly or by way of other points. Points next to each other
in bearing are joined first, which leaves a few runs a scan. That alone would be wrong: an object in front splits the
surface behind it. A point can only be close to others within arcsin(gap / distance) of its bearing, so those few are
looked at, and the runs they belong to are joined. The result is exactly that of the whole matrix of distances.

All scans of a recording are taken at once, as one list of points in the order of scan and bearing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

GAP = 0.05  # m
TURN = 2 * np.pi
FEATURES = ("width", "depth", "girth")


@dataclass(frozen=True, eq=False)
class Points:
    """The points of several scans, scan by scan and in each by bearing.

    Attributes:
        scans: how many scans there are.
        scan: [M], the scan of each point.
        beam: [M], its place in the scan as it was given.
        bearing: [M], 0 to 2 pi.
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
    """Clusters of at least so many points that a feature means something.

    Attributes:
        label: [C], the number that the cluster's points carry.
        scan: [C], the scan it was seen in.
        size: [C], how many points it has.
        centroid: [C, 2] m, mean of its points.
        features: [C, 3] m, with the points in the order of bearing: width from the first to the last one, depth from
            the least to the greatest distance, and girth, the length of the line through them all.
    """

    label: Integers
    scan: Integers
    size: Integers
    centroid: Array
    features: Array


def points_of(ranges: NDArray[np.floating], angles: NDArray[np.floating], nearest: float, farthest: float) -> Points:
    """The points of scans that lie within a distance; no return, whatever it is given as, is no point.

    Args:
        ranges: [N, P] m.
        angles: [P] radians, of each beam, in any order.
        nearest: m, a range below is dropped.
        farthest: m, a range above is dropped.

    Raises:
        ValueError: for shapes that do not fit, or bearings that are not finite.
    """
    ranges, angles = np.asarray(ranges), np.asarray(angles, dtype=np.float64)
    if ranges.ndim != 2 or angles.shape != ranges.shape[1:]:
        given = f"ranges {list(ranges.shape)} and angles {list(angles.shape)}"
        raise ValueError(f"{given} must be [N, P] and [P], N scans of P beams")
    if not np.isfinite(angles).all():
        raise ValueError("angles holds a number that is not finite; give the bearing of each beam in radians")
    bearings = np.mod(angles, TURN)
    order = np.argsort(bearings, kind="stable")
    # Neither NaN nor infinity is within the two.
    scan, place = np.nonzero(((ranges >= nearest) & (ranges <= farthest))[:, order])
    beam = order[place]
    bearing, distance = bearings[beam], ranges[scan, beam].astype(np.float64)
    x, y = distance * np.cos(bearings)[beam], distance * np.sin(bearings)[beam]
    return Points(len(ranges), scan, beam, bearing, distance, x, y)


def single_linkage(points: Points, gap: float = GAP) -> Integers:
    """The number of the cluster that each point belongs to, [M]; clusters are counted through all scans from 0.

    Args:
        points: of any scans.
        gap: m; points closer than this are joined, and those exactly so far apart are not.
    """
    if not len(points.scan):
        return np.zeros(0, dtype=np.int64)
    total = np.arange(len(points.scan))
    scan_begin = np.searchsorted(points.scan, np.arange(points.scans + 1))
    begin, end = scan_begin[points.scan], scan_begin[points.scan + 1]
    apart = (points.scan[1:] != points.scan[:-1]) | ~_closer(points, total[:-1], total[1:], gap)
    run = np.concatenate([[0], np.cumsum(apart)])
    behind_run = np.append(np.flatnonzero(apart) + 1, len(total))[run]

    # Within half a turn: a pair farther apart one way around is nearer the other way. The slack is for rounding.
    with np.errstate(divide="ignore"):
        reach = np.where(points.distance > gap, np.arcsin(np.minimum(1, gap / points.distance)), np.pi) + 1e-9
    farthest, turn = points.bearing + reach, points.scan * (2 * TURN)
    around = farthest >= TURN
    last = np.searchsorted(turn + points.bearing, turn + farthest - TURN * around, side="right")
    count = np.maximum(np.minimum(last + around * (end - begin), total + end - begin) - behind_run, 0)
    one = np.repeat(total, count)
    other = np.arange(len(one)) + np.repeat(behind_run - np.cumsum(count) + count, count)
    other = np.where(other < end[one], other, other - (end - begin)[one])
    close = _closer(points, one, other, gap)
    return _joined(run, run[one[close]], run[other[close]])


def measure(points: Points, label: Integers, least: int = 2) -> Clusters:
    """What the clusters of at least `least` points measure.

    Args:
        points: of any scans, M of them.
        label: [M], the cluster of each.
        least: clusters of fewer points are left out.
    """
    order = np.argsort(label, kind="stable")
    order = order[np.bincount(label)[label[order]] >= least]
    if not len(order):
        none = np.zeros(0, dtype=np.int64)
        return Clusters(none, none, none, np.zeros((0, 2)), np.zeros((0, 3)))
    first, last = _blocks(label[order])
    order = _unwrapped(points.bearing, order, first, last)
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


def _joined(label: Integers, one: Integers, other: Integers) -> Integers:
    """The labels [M] after those of each pair have become one; again they are counted from 0."""
    lowest = np.arange(int(label[-1]) + 1)
    while (lowest[one] != lowest[other]).any():
        for low, high in ((one, other), (other, one)):
            np.minimum.at(lowest, lowest[high], lowest[low])
        lowest = lowest[lowest]
    kept = lowest == np.arange(len(lowest))
    return (np.cumsum(kept) - 1)[lowest][label]


def _closer(points: Points, one: Integers, other: Integers, gap: float) -> NDArray[np.bool_]:
    x, y = points.x[one] - points.x[other], points.y[one] - points.y[other]
    return np.asarray(x * x + y * y < gap * gap)


def _blocks(label: Integers) -> tuple[Integers, Integers]:
    """Where each of the blocks of equal labels begins, and its last place."""
    ends = np.flatnonzero(label[1:] != label[:-1])
    return np.append(0, ends + 1), np.append(ends, len(label) - 1)


def _unwrapped(bearing: Array, order: Integers, first: Integers, last: Integers) -> Integers:
    """The order [M] in which clusters that lie across bearing 0 begin behind their widest gap."""
    turned = bearing[order]
    # Whoever spans at most half a turn leaves the widest gap outside already.
    if not (turned[last] - turned[first] > np.pi).any():
        return order
    cluster = np.repeat(np.arange(len(first)), last - first + 1)
    gap = np.diff(turned, prepend=turned[0])
    gap[first] = TURN - (turned[last] - turned[first])
    widest = np.flatnonzero(gap == np.maximum.reduceat(gap, first)[cluster])
    start = widest[_blocks(cluster[widest])[0]]
    before = np.arange(len(order)) < start[cluster]
    return order[np.lexsort((turned + TURN * before, cluster))]
