"""Bearings of the ranges of scans whose angles contradict each other."""

import math

import numpy as np
import pytest

from coil_rl.envs.recordings.bearings import Angles, bearings

STEP = 2 * math.pi / 360
LAST = -math.pi + 359 * STEP


def taken(first, last, step, points=360):
    """The bearings of one scan with 32-bit angles, and its remarks."""
    angles = Angles(*(float(np.float32(number)) for number in (first, last, step)))
    [[start, increment]], remarks = bearings([angles], np.array([points]))
    return start + increment * np.arange(points), remarks


@pytest.mark.parametrize(
    ("angles", "words"),
    [
        ((-math.pi, LAST, STEP), None),
        ((-math.pi, LAST, 2 * math.pi / 361), "does not lead to angle_max"),
        ((-math.pi, LAST, 0.0), "does not lead to angle_max"),
        ((-math.pi, math.pi, STEP), "one step beyond the last range"),
        ((-math.pi, 0.0, STEP), "has no angle_max"),
        ((-math.pi, math.nan, STEP), "has no angle_max"),
        ((LAST, -math.pi, STEP), "taken as exchanged"),
        ((-math.pi, LAST, 1.0), "does not lead to angle_max"),
        ((-math.pi, 200.0, STEP), "an angle_max that is no bearing"),
    ],
)
def test_bearings_are_those_that_were_meant(angles, words):
    found, remarks = taken(*angles)
    np.testing.assert_allclose(found, -math.pi + STEP * np.arange(360), atol=1e-5)
    assert remarks == [] if words is None else words in remarks[0]


def test_clockwise_scans_leave_no_doubt():
    found, remarks = taken(LAST, -math.pi, -STEP)
    np.testing.assert_allclose(found, LAST - STEP * np.arange(360), atol=1e-5)
    assert remarks == []


@pytest.mark.parametrize(("step", "turns"), [(7.0, "400.0"), (-5.0, "285.7")])
def test_scan_over_many_turns_is_said_to_be_one(step, turns):
    _, remarks = taken(0.0, 359 * step, step)
    assert f"has ranges over {turns} turns, so its angles mean little" in remarks[0]


def test_short_scan_has_the_step_of_the_others():
    angles = [Angles(-math.pi, LAST, STEP)] * 3
    found, remarks = bearings(angles, np.array([360, 360, 90]))
    assert (found == [-math.pi, STEP]).all()
    assert remarks == []
    assert bearings(angles, np.array([0, 1, 0]))[1] == []
