import numpy as np
import pytest

from coil_rl.envs import robot_track
from coil_rl.envs.robot_course import THICK, THIN, cones_of, middle_line


def test_a_lap_is_six_metres_with_a_straight_a_left_turn_and_a_right_turn():
    track = robot_track()
    line = middle_line(track, 0.03)
    assert track.length == pytest.approx(6.0, abs=0.05)
    way = np.roll(line, -1, axis=0) - line
    heading = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    # Over 15 cm, for the middle between two splines is a little rough.
    bend = (np.roll(heading, -5) - heading)[:-10] / 0.15
    assert bend.max() > 1.2  # 1/m, left
    assert bend.min() < -1.2
    straight = np.abs(bend) < 0.2
    assert straight.mean() > 0.12
    assert heading[-1] - heading[0] == pytest.approx(2 * np.pi, abs=0.1)


def test_cones_stand_evenly_and_leave_room_for_the_robot():
    track = robot_track()
    for ring in (track.left, track.right):
        gaps = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
        assert (np.abs(gaps - 0.23) < 0.02).all()
    across = np.linalg.norm(track.left[:, None] - track.right, axis=-1).min(1)
    assert (np.abs(across - 0.36) < 0.03).all()


def test_thin_cones_are_left_and_thick_ones_right():
    track = robot_track()
    place, radius = cones_of(track)
    assert place.shape == (2, len(track.left) + len(track.right))
    assert radius.tolist() == pytest.approx([THIN] * len(track.left) + [THICK] * len(track.right))
    np.testing.assert_allclose(cones_of(track, left=False)[0].T, track.right, atol=1e-6)
    np.testing.assert_allclose(cones_of(track, right=False)[0].T, track.left, atol=1e-6)
    with pytest.raises(ValueError, match="neither left nor right"):
        cones_of(track, left=False, right=False)
