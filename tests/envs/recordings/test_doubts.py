"""What makes the meaning of a recording doubtful is said when it is read."""

import warnings

import numpy as np
import odd_recordings as odd
import pytest

from coil_rl.envs.recordings.folders import RecordingError
from coil_rl.envs.recordings.reading import read_recording

# What the perception or the size of the robot tells is said by a replay, see test_cautions.py.
OF_A_REPLAY = (
    odd.mirrored,
    odd.backwards,
    odd.turned_left,
    odd.clockwise_with_a_positive_step,
    odd.room,
    odd.commands_in_degrees,
    odd.ackermann_in_degrees,
)


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return odd.good_drive(tmp_path_factory.mktemp("good"))


def changed(good, change, folder):
    drive = odd.messages_of(good)
    change(drive)
    return odd.write(folder / "odd.mcap", drive)


def remarks(path):
    """All remarks on a recording, or the sentence with which it is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return list(read_recording(path).remarks)
        except RecordingError as error:
            return [str(error)]


def test_good_drive_leaves_no_doubts(good, tmp_path):
    assert remarks(good) == remarks(odd.write(tmp_path / "same.mcap", odd.messages_of(good))) == []


@pytest.mark.parametrize("change", [each for each in odd.ODD if each not in OF_A_REPLAY])
def test_odd_recording_is_said_to_be_odd(good, change, tmp_path):
    said, words = remarks(changed(good, change, tmp_path)), odd.ODD[change]
    assert any(words in remark for remark in said) if words else said == [], said


@pytest.mark.parametrize("change", odd.ODD_FOLDERS)
def test_odd_folder_is_said_to_be_odd(good, change, tmp_path):
    said, words = remarks(odd.make_odd_folder(tmp_path, good, change)), odd.ODD_FOLDERS[change]
    assert any(words in remark for remark in said) if words else said == [], said


def test_command_that_is_too_old_is_none(good, tmp_path):
    with pytest.warns(UserWarning, match="has no command of the last"):
        recording = read_recording(changed(good, odd.commands_end_early, tmp_path))
    known = ~np.isnan(recording.commands_of_scans(0.15)[:, 1])
    # The twelfth command is sent with the twelfth scan, and counts for three turns.
    assert known.tolist() == [True] * 15 + [False] * 29


def test_command_long_after_the_last_scan_before_a_gap_does_not_belong_to_it(good, tmp_path):
    def early_gap(drive):
        del drive.scans[5:40], drive.commands[4:35]

    with pytest.warns(UserWarning, match="has 1 gap of more than 2.5 turns"):
        recording = read_recording(changed(good, early_gap, tmp_path))
    # Without the gap it would be the fifth command, which is sent just before the sixth scan.
    assert recording.commands_of_scans(0.15)[4, 1] == recording.commands[0][3, 1]


@pytest.mark.parametrize("kind", [odd.ackermann, odd.ackermann_stamped])
def test_ackermann_commands_are_steering_angles(good, kind, tmp_path):
    twists = read_recording(good)
    with pytest.warns(UserWarning, match="those on /drive are read instead"):
        angles = read_recording(changed(good, kind, tmp_path))
    assert (angles.steered, twists.steered) == (True, False)
    expected = twists.commands[0][:, 1]
    found = 0.15 * np.sin(angles.commands[0][:, 1]) / (2 / 7)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_poses_of_ackermann_commands_are_those_of_the_turn_rates(good, tmp_path):
    def without_odometry(drive):
        odd.ackermann(drive)
        drive.odometry = []

    twists = read_recording(good, odometry=None)
    with pytest.warns(UserWarning, match="read instead"):
        angles = read_recording(changed(good, without_odometry, tmp_path))
    np.testing.assert_allclose(angles.poses(2 / 7)[:, :2], twists.poses()[:, :2], atol=1e-5)


def test_steering_that_a_replay_added_is_not_taken_for_commands(good, tmp_path):
    def annotated(drive):
        drive.command_topic = "/coil/spline/cmd_vel"

    recording = read_recording(changed(good, annotated, tmp_path))
    assert (recording.commands, list(recording.remarks)) == (None, [])
