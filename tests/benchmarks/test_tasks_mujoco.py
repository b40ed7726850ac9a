"""Controllers of MuJoCo tasks, without MuJoCo."""

import numpy as np
import pytest

from benchmarks.guide_benchmark.tasks_mujoco import LINKS, AngleFeedback, Reach, StateFeedback


def tip(angles):
    """Return the position of the fingertip, m, of two angles, rad."""
    first, both = angles[0], angles[0] + angles[1]
    near, far = LINKS
    return np.array(
        [near * np.cos(first) + far * np.cos(both), near * np.sin(first) + far * np.sin(both)]
    )


def seen(angles, target, speeds=(0.0, 0.0)):
    """Return what Reacher-v5 observes."""
    return np.concatenate([np.cos(angles), np.sin(angles), target, speeds, tip(angles) - target])


@pytest.mark.parametrize("bend", [1.0, 2.0, -1.5])
def test_reach_moves_the_tip_straight_to_the_target(bend):
    angles, target = np.array([0.4, bend]), np.array([-0.05, 0.1])
    action = Reach(gain=0.01, damping=0.0).act(seen(angles, target))
    moved, way = tip(angles + 1e-3 * action) - tip(angles), target - tip(angles)
    assert moved @ way > 0.99 * np.linalg.norm(moved) * np.linalg.norm(way)


def test_reach_brakes_and_keeps_its_bounds():
    angles = np.array([0.4, 1.0])
    still = seen(angles, tip(angles), speeds=(2.0, -4.0))
    np.testing.assert_allclose(Reach().act(still), [-0.1, 0.2])
    assert (abs(Reach(gain=100.0).act(seen(angles, np.zeros(2)))) == 1).any()


def test_feedbacks_push_towards_the_side_on_which_the_poles_lean():
    np.testing.assert_allclose(AngleFeedback().act(np.array([9.0, 0.1, 9.0, 0.2])), [0.6])
    gains = (-0.21, -1.81, -5.57, -0.31, -0.9, -0.85)
    for place, gain in zip((0, 1, 2, 5, 6, 7), gains, strict=True):
        observation = 0.1 * np.eye(9)[place]
        np.testing.assert_allclose(StateFeedback().act(observation), [0.1 * gain])
