"""What makes the meaning of a recording doubtful is said when it is read."""

import warnings

import numpy as np
import odd_recordings as odd
import pytest
import zstandard
from drives import rosbag_of, store

from coil_rl.envs.recordings.folders import RecordingError
from coil_rl.envs.recordings.messages import encode
from coil_rl.envs.recordings.reading import read_recording


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return odd.good_drive(tmp_path_factory.mktemp("good"))


def remarks(path):
    """All remarks on a recording, or the sentence with which it is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return list(read_recording(path).remarks)
        except RecordingError as error:
            return [str(error)]


@pytest.mark.slow
def test_good_drive_leaves_no_doubts(good, tmp_path):
    assert remarks(good) == []
    assert remarks(odd.changed(good, odd.stamped_commands, tmp_path)) == []


@pytest.mark.parametrize(("change", "words"), odd.OF_A_READING)
def test_odd_recording_is_said_to_be_odd(good, change, words, tmp_path):
    said = remarks(odd.changed(good, change, tmp_path))
    assert any(words in remark for remark in said), said


@pytest.mark.parametrize(("change", "words"), odd.OF_A_FOLDER)
def test_odd_folder_is_said_to_be_odd(good, change, words, tmp_path):
    said = remarks(odd.changed_folder(good, change, tmp_path))
    assert any(words in remark for remark in said) if words else said == [], said


def test_command_that_is_too_old_is_none(good, tmp_path):
    with pytest.warns(UserWarning, match="has no command of the last"):
        recording = read_recording(odd.changed(good, odd.commands_end_early, tmp_path))
    known = ~np.isnan(recording.commands_of_scans(0.15)[:, 1])
    # The twelfth command is sent with the twelfth scan, and counts for three turns.
    assert known.tolist() == [True] * 15 + [False] * 29


@pytest.mark.parametrize(("change", "words"), odd.IN_BURSTS)
def test_commands_belong_to_the_scans_of_their_time_and_not_of_their_log(
    good, change, words, tmp_path
):
    expected = read_recording(good).commands_of_scans(0.15)
    with pytest.warns(UserWarning, match=words):
        found = read_recording(odd.changed(good, change, tmp_path)).commands_of_scans(0.15)
    np.testing.assert_allclose(found, expected)


def test_command_of_another_type_is_no_label_for_its_scan(good, tmp_path):
    with pytest.warns(UserWarning, match="22 of geometry_msgs/msg/Twist are read"):
        recording = read_recording(odd.changed(good, odd.stamped_commands_by_turns, tmp_path))
    commands = recording.commands_of_scans(0.15)[:, 1]
    assert np.isnan(commands).tolist() == [False, True] * 22
    np.testing.assert_allclose(commands[::2], read_recording(good).commands_of_scans(0.15)[::2, 1])


def test_log_clock_that_is_set_back_is_named_and_stamps_give_the_order(good, tmp_path):
    messages = [
        (topic, kind, time - 5 * 10**9 * (time > odd.START + 4 * 10**9), fields)
        for topic, kind, time, fields in odd.messages_of(good).all()
    ]
    with pytest.warns(UserWarning, match="log times that step back by 4.82 s, so stamps give"):
        recording = read_recording(rosbag_of(tmp_path / "back", *messages))
    assert len(recording.remarks) == 1
    expected = read_recording(good)
    np.testing.assert_array_equal(recording.ranges, expected.ranges)
    found = recording.commands_of_scans(0.15)
    np.testing.assert_allclose(found, expected.commands_of_scans(0.15))
    np.testing.assert_allclose(recording.poses(), expected.poses())


def test_messages_that_are_compressed_one_by_one_are_named(tmp_path):
    scan = zstandard.compress(encode(odd.SCAN, {"ranges": np.ones(9)}))
    path = store(tmp_path / "compressed.mcap", scan)
    assert "compression_mode: MESSAGE); convert its folder" in remarks(path)[0]


def test_command_long_after_the_last_scan_before_a_gap_does_not_belong_to_it(good, tmp_path):
    def early_gap(drive):
        del drive.scans[5:40], drive.commands[4:35]

    with pytest.warns(UserWarning, match="has 1 gap of more than 2.5 turns"):
        recording = read_recording(odd.changed(good, early_gap, tmp_path))
    # Without the gap it would be the fifth command, which is sent just before the sixth scan.
    assert recording.commands_of_scans(0.15)[4, 1] == recording.commands[0][3, 1]


@pytest.mark.parametrize("stamped", [False, True])
def test_ackermann_commands_are_steering_angles(good, stamped, tmp_path):
    twists = read_recording(good)
    path = odd.changed(good, odd.ackermann("/drive", stamped=stamped), tmp_path)
    with pytest.warns(UserWarning, match="those on /drive are read instead"):
        angles = read_recording(path)
    assert (angles.steered, twists.steered) == (True, False)
    expected = twists.commands[0][:, 1]
    found = 0.15 * np.sin(angles.commands[0][:, 1]) / (2 / 7)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_poses_of_ackermann_commands_are_those_of_the_turn_rates(good, tmp_path):
    twists = read_recording(good, odometry=None)
    angles = read_recording(odd.changed(good, odd.ackermann(), tmp_path), odometry=None)
    assert angles.remarks == []
    np.testing.assert_allclose(angles.poses(2 / 7)[:, :2], twists.poses()[:, :2], atol=1e-5)


def test_steering_that_a_replay_added_is_not_taken_for_commands(good, tmp_path):
    drive = odd.messages_of(good)
    drive.command_topic = "/coil/spline/cmd_vel"
    recording = read_recording(odd.write(tmp_path / "annotated.mcap", drive))
    assert (recording.commands, list(recording.remarks)) == (None, [])
