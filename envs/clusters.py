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
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

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
    begin, size = scan_begin[points.scan], np.diff(scan_begin)[points.scan]
    apart = (points.scan[1:] != points.scan[:-1]) | ~_closer(points, total[:-1], total[1:], gap)
    run = np.concatenate([[0], np.cumsum(apart)])
    first_after = np.append(np.flatnonzero(apart) + 1, len(total))[run]

    # Within half a turn: a pair farther apart one way around is nearer the other way. The slack is for rounding.
    with np.errstate(divide="ignore"):
        reach = np.where(points.distance > gap, np.arcsin(np.minimum(1, gap / points.distance)), np.pi) + 1e-9
    one, other = total, first_after
    joined: list[tuple[Integers, Integers]] = []
    while len(one):
        past = other >= begin[one] + size[one]
        at = other - past * size[one]
        near = (other - one < size[one]) & (points.bearing[at] - points.bearing[one] + past * TURN <= reach[one])
        one, other, at = one[near], other[near] + 1, at[near]
        close = _closer(points, one, at, gap)
        joined.append((run[one[close]], run[at[close]]))
    first, second = (np.concatenate(end) for end in zip(*joined, strict=True))
    if (first == second).all():  # which a graph takes long to say
        return run
    runs = int(run[-1]) + 1
    graph = coo_array((np.ones(len(first), dtype=np.int8), (first, second)), shape=(runs, runs))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)[run]


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
    first = _firsts(label[order])
    order = _unwrapped(points.bearing, order, first)
    x, y, distance = points.x[order], points.y[order], points.distance[order]
    size = np.diff(first, append=len(order))
    last = first + size - 1
    step = np.hypot(np.diff(x, prepend=x[0]), np.diff(y, prepend=y[0]))
    step[first] = 0
    width = np.hypot(x[last] - x[first], y[last] - y[first])
    depth = np.maximum.reduceat(distance, first) - np.minimum.reduceat(distance, first)
    features = np.stack([width, depth, np.add.reduceat(step, first)], axis=1)
    centroid = np.stack([np.add.reduceat(axis, first) / size for axis in (x, y)], axis=1)
    return Clusters(label[order[first]], points.scan[order[first]], size, centroid, features)


def _closer(points: Points, one: Integers, other: Integers, gap: float) -> NDArray[np.bool_]:
    x, y = points.x[one] - points.x[other], points.y[one] - points.y[other]
    return np.asarray(x * x + y * y < gap * gap)


def _firsts(label: Integers) -> Integers:
    """Where each of the blocks of equal labels begins."""
    return np.flatnonzero(np.diff(label, prepend=label[0] - 1))


def _unwrapped(bearing: Array, order: Integers, first: Integers) -> Integers:
    """The order [M] in which clusters that lie across bearing 0 begin behind their widest gap."""
    turned, size = bearing[order], np.diff(first, append=len(order))
    # Whoever spans at most half a turn leaves the widest gap outside already.
    if not (turned[first + size - 1] - turned[first] > np.pi).any():
        return order
    cluster = np.repeat(np.arange(len(first)), size)
    gap = np.diff(turned, prepend=turned[0])
    gap[first] = TURN - (turned[first + size - 1] - turned[first])
    widest = np.flatnonzero(gap == np.maximum.reduceat(gap, first)[cluster])
    start = widest[_firsts(cluster[widest])]
    before = np.arange(len(order)) < start[cluster]
    return order[np.lexsort((turned + TURN * before, cluster))]
