"""Clusters of LiDAR points."""

import numpy as np
import pytest
from drives import SENSORS, real_recording
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from coil_rl.envs.robot.clusters import GAP, measure, points_of, single_linkage

CIRCLE = np.arange(360) * 2 * np.pi / 360 - np.pi


def dense(points, scan, gap):
    """The connected components of the full distance matrix of a scan, as sets of points."""
    rows = np.flatnonzero(points.scan == scan)
    x, y = (axis[rows][:, None] - axis[rows] for axis in (points.x, points.y))
    return as_sets(connected_components(x * x + y * y < gap * gap)[1], rows) if len(rows) else []


def as_sets(labels, rows):
    groups = {}
    for label, row in zip(labels.tolist(), rows.tolist(), strict=True):
        groups.setdefault(label, set()).add(row)
    return sorted(map(frozenset, groups.values()), key=min)


def expect_exact(ranges, angles, range_min=0.02, range_max=1.15, gap=GAP):
    points = points_of(ranges, angles, range_min, range_max)
    label = single_linkage(points, gap)
    for scan in range(points.scans):
        rows = np.flatnonzero(points.scan == scan)
        assert as_sets(label[rows], rows) == dense(points, scan, gap)
    assert len(label) == len(points.scan)
    numbers = np.unique(label)
    assert numbers.tolist() == list(range(len(numbers)))
    return len(numbers)


def scans(seed, count, beams=360):
    """Discs, walls, dropouts and clutter, some in front of others."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(-np.pi, np.pi, beams)
    if seed % 2:
        angles = np.sort(rng.uniform(-np.pi, np.pi, beams))
    ranges = np.full((count, beams), np.inf)
    for row in ranges:
        for _ in range(rng.integers(0, 12)):
            distance, width = rng.uniform(0.03, 1.3), rng.uniform(0.02, 1.5)
            bearing = rng.uniform(-np.pi, np.pi)
            off = np.abs((angles - bearing + np.pi) % (2 * np.pi) - np.pi)
            surface = distance * (1 + 0.3 * off) + rng.normal(0, 0.004, beams)
            row[:] = np.where(off < width, np.minimum(row, surface), row)
        clutter = rng.random(beams) < 0.05
        row[clutter] = rng.uniform(0.0, 1.5, clutter.sum())
        row[rng.random(beams) < 0.1] = rng.choice([np.inf, np.nan, 0.0])
    return ranges, angles


@pytest.mark.parametrize("seed", range(4))
def test_clusters_of_generated_scans_are_connected_components(seed):
    assert expect_exact(*scans(seed, 100)) > 300


@settings(deadline=None, max_examples=50)
@given(
    st.lists(st.floats(0.0, 1.2), min_size=1, max_size=60),
    st.floats(-10, 10),
    st.sampled_from([2 * np.pi, -2 * np.pi, 4.2, 0.3, 9.0]),
    st.floats(0.01, 0.5),
)
def test_clusters_of_any_scan_are_connected_components(ranges, start, span, gap):
    angles = start + np.arange(len(ranges)) * span / len(ranges)
    expect_exact(np.array([ranges, ranges[::-1]]), angles, range_min=1e-4, gap=gap)


def test_clusters_across_the_seam_are_measured_in_order():
    ranges = np.full((2, 360), np.inf)
    ranges[0, [358, 359, 0, 1]] = 0.6  # behind the robot
    ranges[1, [178, 179, 180, 181]] = 0.6  # at bearing 0
    points = points_of(ranges, CIRCLE, 0.15, 1.15)
    found = measure(points, single_linkage(points))
    assert found.scan.tolist() == [0, 1]
    assert found.size.tolist() == [4, 4]
    chord = 2 * 0.6 * np.sin(np.pi / 360)
    expected = [2 * 0.6 * np.sin(3 * np.pi / 360), 0, 3 * chord]
    np.testing.assert_allclose(found.features, [expected] * 2, atol=1e-12)
    np.testing.assert_allclose(np.abs(found.centroid[:, 0]), 0.6, atol=1e-3)
    assert found.centroid[0, 0] < 0 < found.centroid[1, 0]


def test_points_at_exactly_the_gap_are_not_linked():
    ranges, angles = np.array([[0.25, 0.5]]), np.zeros(2)
    assert len(set(single_linkage(points_of(ranges, angles, 0.1, 1.0), gap=0.25))) == 2
    assert len(set(single_linkage(points_of(ranges, angles, 0.1, 1.0), gap=0.2500001))) == 1


def test_ranges_outside_the_limits_are_no_points():
    ranges = np.array([[np.nan, np.inf, -np.inf, 0.0, 0.1499, 0.15, 1.15, 1.1501, -1.0]])
    assert points_of(ranges, np.arange(9.0), 0.15, 1.15).beam.tolist() == [5, 6]
    empty = points_of(np.full((3, 4), np.inf), np.arange(4.0), 0.15, 1.15)
    assert measure(empty, single_linkage(empty)).features.shape == (0, 3)


def test_features_match_their_definition():
    ranges, angles = scans(3, 40)
    points = points_of(ranges, angles, 0.02, 1.15)
    label = single_linkage(points)
    found = measure(points, label)
    assert len(found.size) > 100
    for row, number in enumerate(found.label):
        of = np.flatnonzero(label == number)
        if np.ptp(points.bearing[of]) > np.pi:
            continue  # tested above
        place = np.stack([points.x[of], points.y[of]], axis=1)
        girth = np.linalg.norm(np.diff(place, axis=0), axis=1).sum()
        expected = [np.linalg.norm(place[-1] - place[0]), np.ptp(points.distance[of]), girth]
        np.testing.assert_allclose(found.features[row], expected, atol=1e-12)
        np.testing.assert_allclose(found.centroid[row], place.mean(axis=0), atol=1e-12)
    assert sorted(found.label) == [n for n in np.unique(label) if (label == n).sum() >= 2]


def test_each_scan_may_have_its_own_bearings():
    (first, one), (second, other) = scans(1, 3), scans(3, 3)
    together = points_of(
        np.concatenate([first, second]), np.repeat([one, other], 3, axis=0), 0.02, 1.15
    )
    alone = points_of(first, one, 0.02, 1.15), points_of(second, other, 0.02, 1.15)
    for name in ("beam", "bearing", "distance", "x", "y"):
        parts = [getattr(points, name) for points in alone]
        assert np.array_equal(getattr(together, name), np.concatenate(parts))
    assert np.array_equal(together.scan, np.concatenate([alone[0].scan, alone[1].scan + 3]))


def test_shapes_that_do_not_match_are_refused():
    with pytest.raises(ValueError, match=r"ranges \[3, 4\] and angles \[5\] must be"):
        points_of(np.zeros((3, 4)), np.zeros(5), 0, 1)
    with pytest.raises(ValueError, match="not finite"):
        points_of(np.zeros((3, 2)), np.array([0, np.nan]), 0, 1)


@pytest.mark.parametrize(("name", "topic"), SENSORS)
def test_clusters_of_real_scans_are_connected_components(name, topic):
    recording = real_recording(name, topic)
    points = points_of(recording.ranges, recording.angles(0), 0.0, 1.15)
    clusters = measure(points, single_linkage(points))
    count = expect_exact(recording.ranges, recording.angles(0), 0.0)
    assert (count, len(clusters.size)) == SENSORS[name, topic][2:4]
    assert (clusters.features >= 0).all()
