"""The track of the simulated robot, distances to a crash, and laps."""

import math

import numpy as np
import pytest
import torch

from coil_rl.envs import TrackError, robot_track, robot_tracks
from coil_rl.envs.robot.course import (
    THICK,
    THIN,
    RobotCourse,
    cones_of,
    laps,
    middle_line,
    noted_track,
    track_notes,
)


def test_lap_is_six_metres_with_a_straight_a_left_turn_and_a_right_turn():
    track = robot_track()
    line = middle_line(track, 0.03)
    assert track.length == pytest.approx(6.0, abs=0.05)
    way = np.roll(line, -1, axis=0) - line
    heading = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    # Over 15 cm, as the line midway between two splines is a little rough.
    curvature = (np.roll(heading, -5) - heading)[:-10] / 0.15
    assert curvature.max() > 1.2  # 1/m, left
    assert curvature.min() < -1.2
    straight = np.abs(curvature) < 0.2
    assert straight.mean() > 0.12
    assert heading[-1] - heading[0] == pytest.approx(2 * np.pi, abs=0.1)
    (large,) = robot_tracks(scale=7.0)
    assert large.length == pytest.approx(7 * track.length, rel=1e-3)


def test_cones_are_missing_or_moved_in_copies_of_the_track():
    track, copies = robot_track(), robot_tracks(count=40, missing=0.1, moved=0.01, seed=3)
    assert len({copy.name for copy in copies}) == 40
    left = [len(copy.left) for copy in copies]
    assert np.mean(left) == pytest.approx(0.9 * len(track.left), rel=0.03)
    assert min(left) < max(left)
    nearest = []
    for copy in copies:
        offsets = copy.right[:, None] - track.right
        own = (offsets**2).sum(-1).argmin(1)
        nearest.append(offsets[np.arange(len(own)), own])
    assert np.concatenate(nearest).std() == pytest.approx(0.01, rel=0.1)
    assert {copy.start for copy in copies} == {track.start}
    again, (unchanged,) = robot_tracks(count=40, missing=0.1, moved=0.01, seed=3), robot_tracks()
    np.testing.assert_array_equal(again[7].left, copies[7].left)
    np.testing.assert_array_equal(unchanged.left, track.left)


def test_cones_are_evenly_spaced_and_leave_room_for_the_robot():
    track = robot_track()
    for ring in (track.left, track.right):
        gaps = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
        assert (np.abs(gaps - 0.23) < 0.02).all()
    across = np.linalg.norm(track.left[:, None] - track.right, axis=-1).min(1)
    assert (np.abs(across - 0.36) < 0.03).all()


def test_thin_cones_are_left_and_thick_ones_right():
    track = robot_track()
    centres, radius = cones_of(track)
    assert centres.shape == (2, len(track.left) + len(track.right))
    assert radius.tolist() == pytest.approx([THIN] * len(track.left) + [THICK] * len(track.right))
    np.testing.assert_allclose(cones_of(track, "right")[0].T, track.right, atol=1e-6)
    np.testing.assert_allclose(cones_of(track, "left")[0].T, track.left, atol=1e-6)


@pytest.mark.parametrize(("heading", "half"), [(0.0, 0.06), (math.pi / 2, 0.10)])
def test_clearance_is_the_distance_of_the_outline_to_a_cone(heading, half):
    course = RobotCourse([robot_track()])
    x, y, _ = robot_track().start
    course.cones, course.radius = torch.tensor([x, y + 0.15]).view(2, 1, 1), torch.tensor([[0.045]])
    clearance, _ = course.clearance(torch.tensor([0]), torch.tensor([[x], [y], [heading]]))
    assert clearance.item() == pytest.approx(0.15 - half - 0.045, abs=1e-5)


def test_noted_track_is_equal_and_invalid_notes_are_refused():
    noted = noted_track(track_notes(robot_track()))
    assert np.array_equal(noted.left, robot_track().left)
    assert np.array_equal(noted.right, robot_track().right)
    assert noted.start == pytest.approx(robot_track().start)
    for notes in ({}, {"left": "[[0, 0]", "right": "[]"}, {"left": "[1, 2, 3]", "right": "[]"}):
        with pytest.raises(TrackError, match="note each side as"):
            noted_track(notes)


def circle(rounds, points=400, radius=1.0, speed=0.5):
    """Poses and times on a circle, anticlockwise from its lowest point."""
    angle = np.linspace(0, rounds * 2 * np.pi, points)
    poses = np.stack([radius * np.sin(angle), -radius * np.cos(angle), angle], axis=1)
    return poses, angle * radius / speed


@pytest.mark.parametrize("turn", [0.0, 2.5, -1.9])
def test_laps_of_a_circle_have_its_length_and_duration_from_any_origin(turn):
    poses, seconds = circle(3.2)
    cos, sin = np.cos(turn), np.sin(turn)
    x, y, heading = poses.T
    moved = [cos * x - sin * y + 5, sin * x + cos * y - 3, heading + turn]
    found = laps(np.stack(moved, axis=1), seconds)
    assert found.metres == pytest.approx([2 * np.pi] * 3, rel=1e-3)
    assert found.seconds == pytest.approx([4 * np.pi] * 3, rel=1e-3)


def test_only_complete_laps_count_without_the_time_before_the_start():
    assert [len(laps(*circle(rounds)).seconds) for rounds in (0.99, 1.01)] == [0, 1]
    poses, seconds = circle(1.2)
    waiting = np.concatenate([np.repeat(poses[:1], 50, axis=0), poses])
    later = np.concatenate([np.arange(50), seconds + 50])
    assert laps(waiting, later).seconds == pytest.approx([4 * np.pi], rel=1e-3)
    swaying = np.outer([0, 0.1, -0.1, 0.1, -0.1, 0.1], [1, 0, 0])
    assert len(laps(swaying, np.arange(6.0)).seconds) == 0


def test_clearance_is_that_of_norms_over_all_points_to_the_last_bit():
    course, draw = RobotCourse(robot_tracks(count=2)), torch.Generator().manual_seed(0)
    track = torch.arange(200) % 2
    pose = 3 * torch.rand(3, 200, generator=draw) - 1.5
    _, found = course.clearance(track, pose)
    centre = pose[:2].unsqueeze(-1)
    expected = [(line[:, track] - centre).norm(dim=0).amin(-1) for line in course.boundaries]
    assert torch.equal(found, torch.stack(expected))
