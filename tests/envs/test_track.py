"""Tracks: geometry, and one-sentence errors for invalid tracks."""

import re

import numpy as np
import pytest
from ovals import circle
from scipy.spatial import cKDTree

from coil_rl.envs import shipped_tracks
from coil_rl.envs.track import SIDES, Track, TrackError, begin_in_sight, places, resample

TURN = np.linspace(0, 2 * np.pi, 32, endpoint=False)
CIRCLE = circle(1, 32)


def circle_track(**changes):
    """A track between circles of 9 and 11 m, driven anticlockwise."""
    return Track(**({"name": "ring", "left": 9 * CIRCLE, "right": 11 * CIRCLE} | changes))


def test_default_start_is_between_the_last_cones_heading_for_the_finish():
    track = circle_track()
    assert track.finish == pytest.approx([10, 0])
    x, y, heading = track.start
    assert (x, y) == pytest.approx((10 * np.cos(TURN[-1]), 10 * np.sin(TURN[-1])))
    assert heading == pytest.approx(np.arctan2(-y, 10 - x))
    assert circle_track(start=(0, -10, 0)).start == (0.0, -10.0, 0.0)


def test_sides_begin_with_the_first_cones_in_sight_of_the_start():
    track = circle_track(start=(10 * np.cos(TURN[5]), 10 * np.sin(TURN[5]), TURN[5] + np.pi / 2))
    turned = begin_in_sight(track, 7.0, np.pi / 3)
    for side in SIDES:
        before, after = getattr(track, side), getattr(turned, side)
        offset = (before - track.start[:2]) @ [1, 1j] * np.exp(-1j * track.start[2])
        visible = (np.abs(offset) < 7) & (np.abs(np.angle(offset)) < np.pi / 3)
        first = np.flatnonzero(visible)[0]
        assert first > 0
        assert after.tolist() == np.concatenate([before[first:], before[:first]]).tolist()
    assert turned.start == track.start
    assert begin_in_sight(track, 0.1, np.pi / 3).left.tolist() == track.left.tolist()


def test_boundary_of_a_circle_is_that_circle():
    track = circle_track()
    points = track.boundary("left", spacing=0.1)
    assert points[0] == pytest.approx([9, 0])
    assert np.linalg.norm(points, axis=1) == pytest.approx(9, abs=1e-3)
    gaps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    assert gaps.max() < 0.101
    assert gaps.min() > 0.09
    to_cones = np.linalg.norm(track.boundary("right", 0.01)[:, None] - track.right, axis=2)
    assert to_cones.min(axis=0).max() < 0.01


def test_middle_line_is_half_way_and_resampled_evenly():
    middle = circle_track().middle(0.02)
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 10, atol=1e-3)
    even = resample(middle, 0.5)
    assert len(even) == round(20 * np.pi / 0.5)
    steps = np.linalg.norm(np.roll(even, -1, axis=0) - even, axis=1)
    np.testing.assert_allclose(steps, 0.5, rtol=0.01)
    np.testing.assert_allclose(even[0], middle[0])


def test_cones_are_a_read_only_copy():
    left = 9 * CIRCLE
    track = circle_track(left=left)
    left[0] = 100
    assert track.left[0] == pytest.approx([9, 0])
    with pytest.raises(ValueError, match="read-only"):
        track.left[0] = 0


@pytest.mark.parametrize("sides", [{}, {"left": 11 * CIRCLE[::-1], "right": 9 * CIRCLE[::-1]}])
def test_length_is_that_of_the_centre_line_in_either_direction(sides):
    assert circle_track(**sides).length == pytest.approx(20 * np.pi, rel=1e-3)


EXCHANGED = [0, 1, 5, 4, 3, 2, *range(6, 32)]  # cones 2 and 5, 3 and 4
UNKNOWN = np.where(np.arange(32)[:, None] == 5, np.nan, 9 * CIRCLE)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"left": 9 * CIRCLE[:3]}, "left side of track 'ring' has 3 cones"),
        ({"right": 11 * np.ones((8, 3))}, "has 8 cones, of shape [8, 3]"),
        ({"left": UNKNOWN}, "Cone 5 of the left side"),
        ({"right": 11_000 * CIRCLE}, "at most 10000 from the origin"),
        ({"left": np.vstack([9 * CIRCLE, 9 * CIRCLE[:1]])}, "Cones 32 and 0 of the left side"),
        ({"left": 9 * CIRCLE[EXCHANGED]}, "The left side crosses itself near"),
        ({"right": 11 * CIRCLE[EXCHANGED]}, "The right side crosses itself near"),
        ({"left": 9 * CIRCLE + [3, 0]}, "The two sides cross each other near"),
        ({"left": 11 * CIRCLE, "right": 9 * CIRCLE}, "swap LEFT and RIGHT"),
        ({"left": 9 * CIRCLE[::-1]}, "list both sides in driving order"),
        ({"left": 9 * CIRCLE + [50, 0]}, "not on the left of its driving direction"),
        ({"start": (0, 0, 0)}, "The start of track 'ring' at [0.0, 0.0] is not between"),
        ({"right": 11 * np.roll(CIRCLE, 16, axis=0)}, "list both sides from the same place on"),
        ({"start": (10, 0, np.inf)}, "three finite numbers"),
        ({"start": (10, 0)}, "three finite numbers"),
    ],
)
def test_invalid_tracks_are_rejected_with_a_message(changes, words):
    with pytest.raises(TrackError, match=re.escape(words)):
        circle_track(**changes)


def test_crossings_are_tested_on_the_curves_instead_of_the_polygons():
    # The curve through four corners is nearly a circle, and bulges through the straight edges of
    # the larger square.
    corners = np.array([[5, -5], [5, 5], [-5, 5], [-5, -5.0]])
    edge = np.stack([np.full(12, 6.0), np.arange(-6.0, 6.0)], axis=1)
    quarter = np.array([[0, 1], [-1, 0]])
    larger = np.vstack([edge @ np.linalg.matrix_power(quarter, turns) for turns in range(4)])
    with pytest.raises(TrackError, match="The two sides cross each other"):
        circle_track(left=corners, right=larger)


@pytest.mark.parametrize("count", [7, 24, 112])
def test_places_are_spread_along_the_middle_of_each_track(count):
    tracks = shipped_tracks("train")
    index, poses, driven = places(tracks, count)
    assert index.tolist() == [i % len(tracks) for i in range(count)]
    for number, track in enumerate(tracks):
        own, at = poses[index == number], np.sort(driven[index == number])
        lap = np.concatenate([at, at[:1] + track.length])
        assert np.diff(lap).max() < 2.7 * track.length / len(at)
        tree = {side: cKDTree(track.boundary(side)) for side in SIDES}
        left, right = (tree[side].query(own[:, :2])[0] for side in SIDES)
        assert np.abs(left - right).max() < 0.3


def test_places_without_a_count_are_the_starts():
    tracks = shipped_tracks("test")
    index, poses, driven = places(tracks, None)
    assert index.tolist() == [0, 1, 2]
    assert np.isnan(driven).all()
    assert np.array_equal(poses, [track.start for track in tracks])


def test_tracks_are_equal_if_all_of_their_numbers_are():
    again, other = circle_track(), circle_track(left=8 * CIRCLE)
    assert circle_track() == again
    assert len({circle_track(), again, other, circle_track(name="another")}) == 3
