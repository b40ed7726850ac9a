"""What makes a replay doubtful is said: its view, and commands that contradict the odometry."""

import warnings

import numpy as np
import odd_recordings as odd
import pytest

from coil_rl.envs import McapReplayEnv, Perception, simulated_cone_classifier
from coil_rl.envs.recordings.cautions import in_order


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return odd.good_drive(tmp_path_factory.mktemp("good"))


def cautioned(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        env = McapReplayEnv(path, Perception(simulated_cone_classifier(), **options))
    return "; ".join(env.cautions(0))


def test_good_drive_gives_no_warning(good):
    assert cautioned(good) == ""


@pytest.mark.parametrize(("change", "words"), odd.OF_A_REPLAY)
def test_scans_and_commands_that_mean_something_else_are_warned_of(good, change, words, tmp_path):
    assert words in cautioned(odd.changed(good, change, tmp_path))


def test_laser_that_points_backwards_fits_with_its_yaw(good, tmp_path):
    path = odd.changed(good, odd.scans(ranges=odd.backwards), tmp_path)
    assert cautioned(path, laser_yaw=180.0) == ""


def test_few_scans_with_both_boundaries_are_warned_of(good, tmp_path):
    def mostly_a_room(drive):
        for _, fields in drive.scans[4:]:
            fields["ranges"] = np.full(360, 0.8, np.float32)

    words = cautioned(odd.changed(good, mostly_a_room, tmp_path))
    assert "only 9% of the scans show both boundaries" in words


def test_order_is_asked_of_the_scans_with_cones_of_both_sides():
    cones = np.zeros((3, 2, 4, 2))
    cones[:, 0, :2, 1], cones[:, 1, :1, 1] = 0.3, -0.3
    cones[1, 0, :2, 1] = -0.6
    count = np.array([[2, 1], [2, 1], [0, 1]])
    assert in_order(cones, count).tolist() == [True, False]
