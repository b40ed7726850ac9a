import numpy as np
import pytest

from coil_rl.envs import shipped_tracks
from coil_rl.listening.sections import LEFT, RIGHT
from coil_rl.report.straightened import Straightened


def around(radius, turn):
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def test_a_ring_becomes_a_straight_of_its_length(ring):
    straight = Straightened(ring)
    assert straight.length == pytest.approx(2 * np.pi * 5, rel=0.005)
    turn = np.linspace(0.1, 6, 50)
    along, aside = straight(around(4.5, turn))
    # Left of a driver who goes around anticlockwise is inside.
    assert aside == pytest.approx(np.full(50, 0.5), abs=0.03)
    assert along == pytest.approx(turn * straight.length / (2 * np.pi), abs=0.05)
    assert straight(around(5.5, turn))[1] == pytest.approx(np.full(50, -0.5), abs=0.03)


def test_left_cones_are_on_the_left_and_the_middle_is_in_the_middle():
    for track in shipped_tracks("test"):
        straight = Straightened(track)
        assert (straight(track.left)[1] > 0.5).all()
        assert (straight(track.right)[1] < -0.5).all()
        assert np.abs(straight(straight.line)[1]).max() < 1e-9
        assert {LEFT, RIGHT} <= set(straight.kinds)


def test_no_places_are_none(ring):
    along, aside = Straightened(ring)(np.empty((0, 2)))
    assert along.shape == aside.shape == (0,)
