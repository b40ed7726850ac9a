"""Warnings on a perception that does not fit a recording, and on commands beyond the robot."""

import warnings

import numpy as np
import odd_recordings as odd
import pytest

from coil_rl.envs import McapReplayEnv, Perception, simulated_cone_classifier
from coil_rl.envs.recordings.views import share_in_order
from coil_rl.guides import ConstantGuide
from coil_robot.replay.cautions import caution
from coil_robot.replay.open_loop import open_loop


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return odd.good_drive(tmp_path_factory.mktemp("good"))


def cautioned(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = McapReplayEnv(path, Perception(simulated_cone_classifier(), **options))
    [result] = open_loop(env, {"straight": (env, ConstantGuide(0.0))})
    return caution(result, env.perception)


def changed(good, change, folder):
    drive = odd.messages_of(good)
    change(drive)
    return odd.write(folder / "odd.mcap", drive)


def test_good_drive_gives_no_warning(good):
    assert cautioned(good) == ""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (odd.mirrored, "the left cones lie left of the right ones in only"),
        (odd.clockwise_with_a_positive_step, "the scans are mirrored"),
        (odd.backwards, "perception.laser_yaw, 180 for a laser that points backwards"),
        (odd.turned_left, "no scan shows both boundaries"),
        (odd.room, "no scan shows both boundaries"),
        (odd.commands_in_degrees, "recorded turn rates are beyond what the robot can steer"),
        (odd.ackermann_in_degrees, "recorded steering angles are beyond"),
    ],
)
def test_scans_and_commands_that_mean_something_else_are_warned_of(good, change, words, tmp_path):
    assert words in cautioned(changed(good, change, tmp_path))


def test_laser_that_points_backwards_fits_with_its_yaw(good, tmp_path):
    assert cautioned(changed(good, odd.backwards, tmp_path), laser_yaw=180.0) == ""


def test_few_scans_with_both_boundaries_are_warned_of(good, tmp_path):
    def mostly_a_room(drive):
        for _, fields in drive.scans[4:]:
            fields["ranges"] = np.full(360, 0.8, np.float32)

    words = cautioned(changed(good, mostly_a_room, tmp_path))
    assert "only 9% of the scans show both boundaries" in words


def test_share_in_order_counts_the_scans_with_cones_of_both_sides():
    cones = np.zeros((3, 2, 4, 2))
    cones[:, 0, :2, 1], cones[:, 1, :1, 1] = 0.3, -0.3
    cones[1, 0, :2, 1] = -0.6
    count = np.array([[2, 1], [2, 1], [0, 1]])
    assert share_in_order(cones, count) == 0.5
    assert share_in_order(cones[2:], count[2:]) == 1.0
