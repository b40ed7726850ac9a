"""Random tracks: determined by their seed, within the geometric limits of the project."""

import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from coil_rl.envs import track_generator
from coil_rl.envs.level_files import load_track, save_track, shipped_tracks
from coil_rl.envs.track_generator import random_track, random_tracks

SIDES = ("left", "right")
# Seeds of the files in envs/tracks, selected by eye for laps of different lengths and difficulty in
# both directions. After a change of the generator, write each file again:
# save_track(random_track(seed, name), path).
SHIPPED = {"train": [29, 20, 26, 0, 47, 13, 10], "test": [22, 16, 27]}


@pytest.fixture(scope="module")
def tracks():
    return random_tracks(20, seed=7) + shipped_tracks("all")


def edges(ring):
    return np.roll(ring, -1, axis=0) - ring


def curvature(ring):
    """Curvature of a ring [P, 2] of dense points, in 1/m, positive in left turns."""
    steps = edges(ring) @ [1, 1j]
    return 2 * np.angle(steps / np.roll(steps, 1)) / (np.abs(steps) + np.abs(np.roll(steps, 1)))


def centre(track):
    """Smoothed centre line [P, 2], m, about 0.25 m between points."""
    near, far = sorted((track.boundary(side) for side in SIDES), key=len)
    line = (near + far[cKDTree(far).query(near)[1]]) / 2
    window = np.hanning(41) / np.hanning(41).sum()
    axes = [np.convolve(np.pad(axis, 20, mode="wrap"), window, "valid") for axis in line.T]
    return np.stack(axes, axis=1)[::5]


@pytest.mark.slow
def test_cones_have_the_spacing_of_tracks_drawn_by_hand(tracks):
    rings = [ring for track in tracks for ring in (track.left, track.right)]
    gaps = [np.linalg.norm(edges(ring), axis=1) for ring in rings]
    assert min(gap.min() for gap in gaps) > 1.0
    assert max(gap.max() for gap in gaps) < 3.1
    assert np.concatenate(gaps).mean() == pytest.approx(1.6, abs=0.1)


def test_tracks_are_wide_enough_and_vary_in_width(tracks):
    for track in tracks:
        near, _ = cKDTree(track.boundary("left")).query(track.boundary("right"))
        to_cone, _ = cKDTree(track.left).query(track.right)
        assert near.min() > 1.6, track.name
        assert to_cone.max() < 3.7, track.name
        assert np.ptp(near) > 0.3, track.name


def test_tracks_have_various_lengths_and_both_directions(tracks):
    for group in (tracks[:-10], tracks[-10:]):  # random, shipped
        lengths = [track.length for track in group]
        assert 57 < min(lengths) < 75
        assert 130 < max(lengths) < 148
        clockwise = [curvature(track.boundary("left", 0.25)).mean() < 0 for track in group]
        assert 0.25 < np.mean(clockwise) < 0.75


def test_every_track_turns_both_ways_without_tight_turns_or_kinks(tracks):
    for track in tracks:
        bend = curvature(centre(track))
        assert bend.max() > 0.1, track.name
        assert bend.min() < -0.1, track.name
        assert np.abs(bend).max() < 1 / 2.2, track.name
        assert max(np.abs(curvature(track.boundary(side))).max() for side in SIDES) < 1, track.name


def test_tracks_keep_their_distance_from_themselves(tracks):
    for track in tracks:
        for side in SIDES:
            ring = track.boundary(side, 0.5)
            steps = np.abs(np.subtract.outer(np.arange(len(ring)), np.arange(len(ring))))
            far = np.minimum(steps, len(ring) - steps) * 0.5 > 10
            distance = np.linalg.norm(ring[:, None] - ring, axis=2)
            assert distance[far].min() > 1.5, f"{side} of {track.name}"


def test_start_is_on_a_straight_that_leads_to_the_finish(tracks):
    for track in tracks:
        x, y, heading = track.start
        direction = np.array([np.cos(heading), np.sin(heading)])
        assert abs((track.left[0] - track.right[0]) @ direction) < 0.5, track.name
        assert 0.7 < np.linalg.norm(track.finish - (x, y)) < 2.5  # outside the finish circle
        line = centre(track)
        near = np.linalg.norm(line - track.finish, axis=1) < 2.5
        beside = (line[near] - track.finish) @ [-direction[1], direction[0]]
        assert np.abs(beside).max() < 0.4, track.name


def test_tracks_depend_only_on_their_seed():
    state = np.random.get_state()[1].copy()
    one, few, many = random_track(5, "named"), random_tracks(2, seed=5), random_tracks(4, seed=5)
    assert (one.name, random_track(6).name) == ("named", "random_6")
    for track, same in ((one, few[0]), *zip(few, many, strict=False)):
        np.testing.assert_array_equal(track.left, same.left)
        np.testing.assert_array_equal(track.right, same.right)
    assert len({track.left.tobytes() for track in many}) == 4
    np.testing.assert_array_equal(np.random.get_state()[1], state)


@pytest.mark.slow
def test_shipped_tracks_are_those_of_the_recorded_seeds(tmp_path):
    for split, seeds in SHIPPED.items():
        names = [f"{split}_{number}" for number in range(1, len(seeds) + 1)]
        tracks = shipped_tracks(split)
        assert [track.name for track in tracks] == names
        for track, seed in zip(tracks, seeds, strict=True):
            save_track(random_track(seed, track.name), tmp_path / "drawn.csv")
            drawn = load_track(tmp_path / "drawn.csv")
            np.testing.assert_allclose(drawn.left, track.left, atol=1e-4)
            np.testing.assert_allclose(drawn.right, track.right, atol=1e-4)


@pytest.mark.parametrize("seed", [-1, 1.5, True, "3", None])
def test_invalid_arguments_are_rejected(seed):
    random_track(1)
    words = f"seed={seed!r} of a random track must be an integer"
    with pytest.raises(ValueError, match=re.escape(words)):
        random_track(seed)
    with pytest.raises(ValueError, match="must be from 1 to 10000"):
        random_tracks(0, seed=1)


def test_generator_gives_up_after_its_tries(monkeypatch):
    monkeypatch.setattr(track_generator, "TRIES", 3)
    monkeypatch.setattr(track_generator, "RADIUS", 1000.0)
    with pytest.raises(ValueError, match="None of 3 draws of seed 77 makes a track"):
        random_track(77)
