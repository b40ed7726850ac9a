import numpy as np
import pytest

from coil_rl.envs.robot.laps import laps


def circle(turns, points=400, radius=1.0, speed=0.5):
    """Poses and times on a circle, anticlockwise from its lowest point."""
    turn = np.linspace(0, turns * 2 * np.pi, points)
    return np.stack([radius * np.sin(turn), -radius * np.cos(turn), turn], axis=1), turn * radius / speed


def test_a_lap_is_as_long_as_the_circle_and_takes_as_long():
    found = laps(*circle(3.2))
    assert found.metres == pytest.approx([2 * np.pi] * 3, rel=1e-3)
    assert found.seconds == pytest.approx([4 * np.pi] * 3, rel=1e-3)


def test_a_lap_counts_once_it_is_completed():
    assert len(laps(*circle(0.99)).seconds) == 0
    assert len(laps(*circle(1.01)).seconds) == 1


@pytest.mark.parametrize("turn", [0.7, 2.5, -1.9])
def test_laps_are_the_same_wherever_the_odometry_has_its_origin(turn):
    poses, seconds = circle(2.3)
    cos, sin = np.cos(turn), np.sin(turn)
    x, y, heading = poses.T
    moved = np.stack([cos * x - sin * y + 5, sin * x + cos * y - 3, heading + turn], axis=1)
    assert laps(moved, seconds).seconds == pytest.approx(laps(poses, seconds).seconds)


def test_who_stands_first_has_not_lost_any_time():
    poses, seconds = circle(1.2)
    poses = np.concatenate([np.repeat(poses[:1], 50, axis=0), poses])
    seconds = np.concatenate([np.arange(50), seconds + 50])
    assert laps(poses, seconds).seconds == pytest.approx([4 * np.pi], rel=1e-3)


def test_to_sway_at_the_line_is_no_lap():
    x = np.array([0, 0.1, -0.1, 0.1, -0.1, 0.1])
    poses = np.stack([x, 0 * x, 0 * x], axis=1)
    assert len(laps(poses, np.arange(6.0)).seconds) == 0
