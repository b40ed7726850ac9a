"""Random tracks: each fixed by its seed, each within the figures that every track of the project keeps to."""

import re

import numpy as np
import pytest
from scipy.spatial import cKDTree

from coil_rl.envs import track_generator
from coil_rl.envs.level_files import load_track, save_track, shipped_tracks
from coil_rl.envs.track_generator import SHIPPED, random_track, random_tracks, write_shipped_tracks

COUNT = 50
SIDES = ("left", "right")


@pytest.fixture(scope="module")
def tracks():
    return random_tracks(COUNT, seed=7) + shipped_tracks("all")


def edges(ring):
    return np.roll(ring, -1, axis=0) - ring


def bends(ring):
    """Curvature of a ring [P, 2] of points close to each other, in 1/m, left turns above 0."""
    steps = edges(ring) @ [1, 1j]
    return 2 * np.angle(steps / np.roll(steps, 1)) / (np.abs(steps) + np.abs(np.roll(steps, 1)))


def centre(track):
    """[P, 2], m, about 0.25 m apart: half-way between each point of the shorter side and the nearest one across."""
    near, far = sorted((track.boundary(side) for side in SIDES), key=len)
    line = (near + far[cKDTree(far).query(near)[1]]) / 2
    window = np.hanning(41) / np.hanning(41).sum()
    smooth = np.stack([np.convolve(np.pad(axis, 20, mode="wrap"), window, "valid") for axis in line.T], axis=1)
    return smooth[::5]


def test_cones_are_as_far_apart_as_on_a_track_drawn_by_hand(tracks):
    gaps = [np.linalg.norm(edges(getattr(track, side)), axis=1) for track in tracks for side in SIDES]
    assert min(gap.min() for gap in gaps) > 1.0
    assert max(gap.max() for gap in gaps) < 3.1
    assert np.concatenate(gaps).mean() == pytest.approx(1.6, abs=0.1)


def test_sides_are_as_far_apart_as_a_car_needs(tracks):
    for track in tracks:
        near, _ = cKDTree(track.boundary("left")).query(track.boundary("right"))
        to_cone, _ = cKDTree(track.left).query(track.right)
        assert near.min() > 1.6, track.name
        assert to_cone.max() < 3.7, track.name
        assert np.ptp(near) > 0.3, "the width varies along the lap"


def test_laps_are_of_all_lengths(tracks):
    lengths = [track.length for track in tracks]
    assert min(lengths) > 57
    assert max(lengths) < 148
    assert min(lengths) < 75
    assert max(lengths) > 130


def test_every_track_turns_left_and_right_and_never_too_tightly(tracks):
    for track in tracks:
        bend = bends(centre(track))
        assert bend.max() > 0.1, track.name
        assert bend.min() < -0.1, track.name
        assert np.abs(bend).max() < 1 / 2.2, track.name


def test_no_boundary_is_kinked(tracks):
    for track in tracks:
        for side in SIDES:
            assert np.abs(bends(track.boundary(side))).max() < 1, f"{side} of {track.name}"


def test_parts_of_a_track_stay_clear_of_each_other(tracks):
    for track in tracks:
        for side in SIDES:
            ring = track.boundary(side, 0.5)
            apart = np.abs(np.subtract.outer(np.arange(len(ring)), np.arange(len(ring))))
            far = np.minimum(apart, len(ring) - apart) * 0.5 > 10
            distance = np.linalg.norm(ring[:, None] - ring, axis=2)
            assert distance[far].min() > 1.5, f"{side} of {track.name}"


def test_car_starts_on_a_straight_towards_a_finish_that_faces_it(tracks):
    for track in tracks:
        x, y, heading = track.start
        ahead = np.array([np.cos(heading), np.sin(heading)])
        assert abs((track.left[0] - track.right[0]) @ ahead) < 0.5, track.name
        assert 0.7 < np.linalg.norm(track.finish - (x, y)) < 2.5, "outside the finish circle, and near it"
        line = centre(track)
        near = np.linalg.norm(line - track.finish, axis=1) < 2.5
        assert np.abs((line[near] - track.finish) @ [-ahead[1], ahead[0]]).max() < 0.4, track.name


def test_tracks_are_driven_in_both_directions(tracks):
    clockwise = [bends(track.boundary("left", 0.25)).mean() < 0 for track in tracks]
    assert 0.25 < np.mean(clockwise) < 0.75


def test_seed_fixes_the_track():
    first, second, other = random_track(3), random_track(3, "named"), random_track(4)
    np.testing.assert_array_equal(first.left, second.left)
    np.testing.assert_array_equal(first.right, second.right)
    assert (first.name, second.name) == ("random_3", "named")
    assert first.left.shape != other.left.shape or not np.allclose(first.left, other.left)


def test_track_does_not_depend_on_how_many_are_drawn():
    few, many = random_tracks(2, seed=5), random_tracks(4, seed=5)
    for one, same in zip(few, many[:2], strict=True):
        np.testing.assert_array_equal(one.left, same.left)
    np.testing.assert_array_equal(few[0].right, random_track(5).right)
    assert len({track.left.tobytes() for track in many}) == 4


def test_drawing_leaves_the_global_random_state_alone():
    before = np.random.get_state()[1].copy()
    random_track(0)
    np.testing.assert_array_equal(np.random.get_state()[1], before)


def test_generated_track_survives_the_file(tmp_path):
    track = random_track(11)
    save_track(track, tmp_path / "saved.csv")
    again = load_track(tmp_path / "saved.csv")
    np.testing.assert_allclose(again.left, track.left, atol=1e-5)
    np.testing.assert_allclose(again.right, track.right, atol=1e-5)
    assert again.start == pytest.approx(track.start, abs=1e-4)


def test_shipped_tracks_are_those_of_the_recorded_seeds(tmp_path):
    write_shipped_tracks(tmp_path)
    assert {split: len(seeds) for split, seeds in SHIPPED.items()} == {"train": 7, "test": 3}
    for split, seeds in SHIPPED.items():
        shipped = shipped_tracks(split)
        assert [track.name for track in shipped] == list(seeds)
        for track in shipped:
            drawn = load_track(tmp_path / split / f"{track.name}.csv")
            np.testing.assert_allclose(drawn.left, track.left, atol=1e-4)
            np.testing.assert_allclose(drawn.right, track.right, atol=1e-4)


def test_shipped_tracks_differ_in_length_and_direction():
    tracks = shipped_tracks("all")
    lengths = [track.length for track in tracks]
    assert max(lengths) > 2 * min(lengths)
    assert len({bool(bends(track.boundary("left", 0.25)).mean() < 0) for track in tracks}) == 2


@pytest.mark.parametrize("seed", [-1, 1.5, True, "3", None])
def test_seed_that_is_no_whole_number_is_refused(seed):
    with pytest.raises(ValueError, match=re.escape(f"a whole number from 0 on, not {seed!r}")):
        random_track(seed)


def test_no_tracks_at_all_are_refused():
    with pytest.raises(ValueError, match="ask for 1 to 10000"):
        random_tracks(0, seed=1)


def test_draws_that_all_fail_end_in_a_refusal(monkeypatch):
    monkeypatch.setattr(track_generator, "TRIES", 3)
    monkeypatch.setattr(track_generator, "RADIUS", 1000.0)
    with pytest.raises(ValueError, match="None of 3 draws of seed 1 makes a track; take another seed"):
        random_track(1)
