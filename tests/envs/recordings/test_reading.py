"""Recordings: what was recorded comes back as arrays, and what cannot be used is refused in one sentence."""

import hashlib
import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from drives import ODOMETRY, SCAN, START, TURN, TWIST, drive, flipped, scan, store, uncompressed
from rosbags import rosbag1, rosbag2
from rosbags.convert.cli import main as convert
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from coil_rl.envs.recordings.cdr import definition
from coil_rl.envs.recordings.mcap_files import digest
from coil_rl.envs.recordings.reading import RecordingError, read_recording
from coil_rl.envs.recordings.ros_messages import Odometry, Twist

REAL = Path(__file__).parents[3] / "../shared/recordings"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Several chunks of scans, odometry and commands; not to be written to."""
    return drive(tmp_path_factory.mktemp("drives") / "whole.mcap", scans=300, odometry=True, commands=True)


def copy(path, folder):
    made = folder / path.name
    made.write_bytes(path.read_bytes())
    return made


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return path


def refusal(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RecordingError) as caught:
            read_recording(path, **options)
    message = str(caught.value)
    assert message.startswith(str(path.parent))
    assert message.endswith(".")
    assert "\n" not in message
    return message


def test_scans_come_back_as_one_array(whole):
    recording = read_recording(whole)
    turns = [scan(turn) for turn in range(300)]
    np.testing.assert_array_equal(recording.ranges, [turn.ranges for turn in turns])
    assert recording.ranges.flags.c_contiguous
    assert recording.ranges.dtype == np.float32
    np.testing.assert_array_equal(recording.stamp, [turn.stamp for turn in turns])
    np.testing.assert_allclose(recording.angles(7), np.linspace(-3.1241, 3.1241, 360), atol=1e-4)
    np.testing.assert_allclose(recording.seconds, np.arange(300) * TURN / 1e9)
    assert not recording.cut_off


def test_what_is_out_of_range_did_not_come_back(tmp_path):
    turn = scan(0)._replace(ranges=np.array([0.0, 0.1, 0.15, 1.0, 12.0, 12.5, np.nan, np.inf, -1.0], np.float32))
    ranges = read_recording(store(tmp_path / "a.mcap", turn.to_bytes())).ranges
    np.testing.assert_array_equal(ranges, [[np.inf, np.inf, np.float32(0.15), 1, 12, *[np.inf] * 4]])


def test_turns_may_have_different_numbers_of_points(tmp_path):
    turns = [scan(turn, points) for turn, points in enumerate([5, 3, 0, 4])]
    recording = read_recording(store(tmp_path / "a.mcap", *[turn.to_bytes() for turn in turns]))
    assert recording.points.tolist() == [5, 3, 0, 4]
    for row, turn in zip(recording.ranges, turns, strict=True):
        np.testing.assert_array_equal(row[: len(turn.ranges)], turn.ranges)
        assert np.isinf(row[len(turn.ranges) :]).all()


def test_pose_is_that_of_the_odometry_between_its_messages(tmp_path, whole):
    angle = 0.15 * np.arange(300) * TURN / 1e9
    circle = np.stack([np.sin(angle), 1 - np.cos(angle), angle], axis=1)
    np.testing.assert_allclose(read_recording(whole).poses(), circle, atol=1e-9)
    turned = [Odometry(START + 10**9, 2.0, 0.0, 3.1), Odometry(START + 3 * 10**9, 4.0, 1.0, -3.1)]
    store(tmp_path / "odometry.mcap", *[place.to_bytes() for place in turned], kind=ODOMETRY, topic="/odom")
    store(tmp_path / "scans.mcap", *[scan(0)._replace(stamp=START + s * 10**9).to_bytes() for s in range(5)])
    folder = rosbag(tmp_path, "odometry.mcap", "scans.mcap")
    expected = [[2, 0, 3.1], [2, 0, 3.1], [3, 0.5, np.pi], [4, 1, 2 * np.pi - 3.1], [4, 1, 2 * np.pi - 3.1]]
    np.testing.assert_allclose(read_recording(folder).poses(), expected)


def test_pose_follows_from_the_commands_where_there_is_no_odometry(whole):
    angle = 0.15 * np.arange(300) * TURN / 1e9
    circle = np.stack([np.sin(angle), 1 - np.cos(angle), angle], axis=1)
    np.testing.assert_allclose(read_recording(whole, odometry=None).poses(), circle, atol=1e-9)


def test_command_holds_until_the_next(tmp_path):
    store(tmp_path / "scans.mcap", *[scan(0).to_bytes()] * 4)
    twists = [Twist(1.0, 0.0).to_bytes(), Twist(2.0, 0.0).to_bytes(), Twist(0.0, 0.5).to_bytes()]
    store(tmp_path / "commands.mcap", *twists, kind=TWIST, topic="/cmd_vel")
    folder = rosbag(tmp_path, "scans.mcap", "commands.mcap")
    np.testing.assert_allclose(read_recording(folder).poses(), [[0, 0, 0], [1, 0, 0], [3, 0, 0], [3, 0, 0.5]])


def test_nothing_says_that_the_robot_moved(whole):
    assert not read_recording(whole, odometry=None, command=None).poses().any()


def test_order_is_that_of_the_log(tmp_path):
    turns = [scan(turn).to_bytes() for turn in range(4)]
    store(tmp_path / "b.mcap", *turns[:2])
    store(tmp_path / "a.mcap", *turns[2:])
    recording = read_recording(rosbag(tmp_path, "b.mcap", "a.mcap"))
    np.testing.assert_array_equal(recording.log_time - START, np.array([0, 0, 1, 1]) * 10**9)
    np.testing.assert_array_equal((recording.stamp - START) // TURN, [0, 2, 1, 3])


def test_time_is_that_of_the_log_where_the_stamps_run_backwards(tmp_path):
    turns = [scan(turn).to_bytes() for turn in (3, 1, 2)]
    assert read_recording(store(tmp_path / "a.mcap", *turns)).seconds.tolist() == [0, 1, 2]


def rosbag(folder, *files, storage="mcap"):
    """Make a folder a rosbag2 recording of the given files."""
    lines = "".join(f"    - {file}\n" for file in files)
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n"
        f"  storage_identifier: {storage}\n  relative_file_paths:\n{lines}  message_count: 1\n"
    )
    return folder


def test_folder_of_split_files_is_one_recording(tmp_path):
    turns = [scan(turn).to_bytes() for turn in range(5)]
    store(tmp_path / "drive_0.mcap", *turns[:3])
    store(tmp_path / "drive_1.mcap", *turns[3:])
    store(tmp_path / "another.mcap", turns[0])
    recording = read_recording(rosbag(tmp_path, "drive/drive_0.mcap", '"drive_1.mcap"'))
    np.testing.assert_array_equal(np.sort((recording.stamp - START) // TURN), range(5))


def written_by_rosbags(writer, release):
    """Three scans, written by a library that shares nothing with this one."""
    ros = get_typestore(release)
    with writer:
        topic = writer.add_connection("/scan", SCAN, typestore=ros)
        for turn in range(3):
            fields = vars(get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr(scan(turn).to_bytes(), SCAN))
            stamp = ros.types["builtin_interfaces/msg/Time"](**vars(fields["header"].stamp))
            number = {"seq": turn} if release is Stores.ROS1_NOETIC else {}
            fields["header"] = ros.types["std_msgs/msg/Header"](**number, stamp=stamp, frame_id="laser")
            message = ros.types[SCAN](**fields)
            serialize = ros.serialize_ros1 if number else ros.serialize_cdr
            writer.write(topic, scan(turn).stamp, serialize(message, SCAN))


def test_digest_is_that_of_all_files_in_their_order(tmp_path):
    parts = [store(tmp_path / f"{name}.mcap", scan(turn).to_bytes()) for turn, name in enumerate("ab")]
    whole = hashlib.sha256(parts[0].read_bytes() + parts[1].read_bytes()).hexdigest()
    assert digest(rosbag(tmp_path, "a.mcap", "b.mcap")) == whole
    assert digest(rosbag(tmp_path, "b.mcap", "a.mcap")) != whole
    assert digest(parts[0]) == hashlib.sha256(parts[0].read_bytes()).hexdigest()
    with pytest.raises(RecordingError, match="No such file"):
        digest(tmp_path / "missing.mcap")


@pytest.mark.parametrize("kind", ["mcap", "sqlite3", "ros1"])
def test_recording_of_another_library_is_read_once_it_is_in_mcap(tmp_path, monkeypatch, kind):
    path = tmp_path / ("drive.bag" if kind == "ros1" else "drive")
    if kind == "ros1":
        written_by_rosbags(rosbag1.Writer(path), Stores.ROS1_NOETIC)
    else:
        storage = rosbag2.StoragePlugin[kind.upper()]
        written_by_rosbags(rosbag2.Writer(path, version=9, storage_plugin=storage), Stores.ROS2_HUMBLE)
    if kind != "mcap":
        # What the refusal says is what helps.
        remedy = re.search(r"rosbags-convert .*mcap", refusal(path))[0]
        remedy = re.sub("FILE|FOLDER", str(path), remedy).replace("OTHER", str(tmp_path / "new"))
        monkeypatch.setattr("sys.argv", remedy.split())
        with pytest.raises(SystemExit, match="0"):
            convert()
        path = tmp_path / "new"
    np.testing.assert_array_equal(read_recording(path).ranges, [scan(turn).ranges for turn in range(3)])


def test_folder_that_is_no_whole_recording_is_refused(tmp_path):
    store(tmp_path / "drive_0.mcap", scan(0).to_bytes())
    assert "folder without a readable metadata.yaml" in refusal(tmp_path)
    assert "lists drive_1.mcap, which is not there" in refusal(rosbag(tmp_path, "drive_0.mcap", "drive_1.mcap"))
    assert "rosbags-convert" in refusal(rosbag(tmp_path, "drive_0.db3", storage="sqlite3"))
    assert "lists no files" in refusal(rosbag(tmp_path))


OTHERS = {
    "is empty": b"",
    "git lfs pull": b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n",
    "is a ROS 1 bag; convert it": b"#ROSBAG V2.0\nE\x00\x00\x00",
    "is the SQLite storage of a ROS 2 bag; convert": b"SQLite format 3\x00" + bytes(99),
    "compressed as a whole with zstd; unpack it": b"\x28\xb5\x2f\xfd\x04\x00",
    "compressed as a whole with gzip": b"\x1f\x8b\x08\x00",
    "compressed as a whole with lz4": b"\x04\x22\x4d\x18",
    "is a zip archive": b"PK\x03\x04",
    "is not an MCAP file: it begins with 6e 6f": b"no recording",
}


@pytest.mark.parametrize(("reason", "data"), OTHERS.items(), ids=list(OTHERS))
def test_another_file_under_the_name_of_a_recording_is_refused(tmp_path, reason, data):
    path = tmp_path / "drive.mcap"
    path.write_bytes(data)
    assert reason in refusal(path)


def test_missing_file_is_refused(tmp_path):
    assert "No such file" in refusal(tmp_path / "missing.mcap")


def test_what_is_left_of_a_recording_that_was_cut_off_is_read(tmp_path, whole):
    path = cut(copy(whole, tmp_path), 0.6)
    with pytest.warns(UserWarning, match=r"whole\.mcap is cut off: \d+ scans can be read"):
        recording = read_recording(path)
    assert recording.cut_off
    scans = len(recording.ranges)
    assert 120 < scans < 180
    np.testing.assert_array_equal(recording.ranges, [scan(turn).ranges for turn in range(scans)])
    message = refusal(path, strict=True)
    assert f"is cut off: {scans} scans can be read; copy it anew" in message


@pytest.mark.parametrize("compression", [lambda path: path, uncompressed], ids=["zstd", "none"])
def test_recording_may_be_cut_off_anywhere(tmp_path, whole, compression):
    path = compression(copy(whole, tmp_path))
    data = path.read_bytes()
    for size in [*range(1, 300), *range(300, len(data), 9973), *range(len(data) - 60, len(data))]:
        path.write_bytes(data[:size])
        assert "cut off" in refusal(path, strict=True)


def test_recording_cut_off_before_its_first_scan_is_refused(tmp_path, whole):
    assert "cut off before its first scan" in refusal(cut(copy(whole, tmp_path), 0.01))


@pytest.mark.parametrize("compression", [lambda path: path, uncompressed], ids=["zstd", "none"])
def test_damaged_chunk_is_refused(tmp_path, whole, compression):
    path = compression(copy(whole, tmp_path))
    read_recording(path)
    message = refusal(flipped(path, chunk=1))
    assert "is damaged before byte" in message
    assert ", after 17000000" in message
    assert "mcap recover" in message


def test_damaged_length_is_refused(tmp_path, whole):
    path = copy(whole, tmp_path)
    data = bytearray(path.read_bytes())
    data[9:17] = (2**40).to_bytes(8, "little")  # of the header
    path.write_bytes(data)
    assert "is damaged before byte 17 (" in refusal(path)


@pytest.mark.parametrize("compression", [lambda path: path, uncompressed], ids=["zstd", "none"])
def test_damage_anywhere_is_found_or_does_no_harm(tmp_path, compression):
    path = compression(drive(tmp_path / "a.mcap", scans=9, commands=True))
    expected, data = read_recording(path), path.read_bytes()
    draw = np.random.default_rng(0)
    for place in [*range(8, 120), *draw.integers(120, len(data), 200), *range(len(data) - 60, len(data))]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << draw.integers(8)
        path.write_bytes(damaged)
        try:
            recording = read_recording(path, strict=True)
        except RecordingError:
            continue
        np.testing.assert_array_equal(recording.ranges, expected.ranges)
        np.testing.assert_array_equal(recording.commands[0], expected.commands[0])


def test_recording_without_the_topic_is_refused(tmp_path, whole):
    assert "has no topic /front; give the topic of the LiDAR, here /scan" in refusal(whole, scan="/front")
    path = store(tmp_path / "a.mcap", Twist(0, 0).to_bytes(), kind=TWIST, topic="/cmd_vel")
    assert "has no scans of a LiDAR" in refusal(path)
    assert "its topics are: /cmd_vel;" in refusal(path)
    assert "its topics are: none" in refusal(store(tmp_path / "b.mcap"))


@pytest.mark.parametrize("encoding", ["json", "protobuf", "ros1", ""])
def test_other_encodings_are_refused(tmp_path, encoding):
    path = store(tmp_path / "a.mcap", json.dumps({"ranges": [1.0]}).encode(), encoding=encoding)
    message = refusal(path)
    assert f"topic /scan has messages of {SCAN} in {encoding or 'no encoding'}, not of {SCAN} in cdr" in message


@pytest.mark.parametrize("kind", ["sensor_msgs/msg/PointCloud2", "sensor_msgs/LaserScan", "foxglove.LaserScan", ""])
def test_other_types_are_refused(tmp_path, kind):
    message = refusal(store(tmp_path / "a.mcap", bytes(64), kind=kind))
    assert f"topic /scan has messages of {kind or 'no type'} in cdr, not of {SCAN}" in message


def test_topic_of_another_type_is_refused_and_the_right_one_named(whole):
    message = refusal(whole, scan="/odom", odometry=None)
    assert f"topic /odom has messages of {ODOMETRY} in cdr, not of {SCAN} in cdr" in message
    assert "give the topic of such messages, here /scan" in message
    assert "here /cmd_vel" in refusal(whole, command="/odom", odometry=None)
    assert "must be different topics" in refusal(whole, scan="/odom")


@pytest.mark.parametrize("size", [0, 3, 10, 40, 500, 1483])
def test_message_shorter_than_its_lengths_say_is_refused(tmp_path, size):
    turns = [scan(turn).to_bytes() for turn in range(3)]
    message = refusal(store(tmp_path / "a.mcap", turns[0], turns[1][:size], turns[2]))
    assert "topic /scan, message 1 at 1700000001.000 s: it " in message
    assert "record it anew" in message


def test_message_that_is_no_number_is_refused(tmp_path):
    turns = [scan(0).to_bytes(), scan(1)._replace(angle_min=np.nan).to_bytes()]
    assert "message 1 at 1700000001.000 s: the angle" in refusal(store(tmp_path / "a.mcap", *turns))
    place = Odometry(START, np.inf, 0, 0).to_bytes()
    store(tmp_path / "b.mcap", place, kind=ODOMETRY, topic="/odom")
    store(tmp_path / "c.mcap", scan(0).to_bytes())
    assert "topic /odom, message 0" in refusal(rosbag(tmp_path, "b.mcap", "c.mcap"))


def test_scans_without_ranges_are_refused(tmp_path):
    assert "no scan has a range" in refusal(store(tmp_path / "a.mcap", scan(0, 0).to_bytes(), scan(1, 0).to_bytes()))


def test_other_layouts_are_read_by_their_definition(tmp_path):
    big = Twist(0.15, -0.5).to_bytes()
    big = b"\0\0\0\0" + np.frombuffer(big, "<f8", 6, 4).astype(">f8").tobytes()
    store(tmp_path / "commands.mcap", big, big, kind=TWIST, topic="/cmd_vel")
    # A scanner's own definition, with one more number at the end of each message.
    own = definition(SCAN).replace(b"intensities\n", b"intensities\nfloat32 temperature\n")
    turn = scan(0)
    longer = turn.to_bytes() + np.float32(36.6).tobytes()
    store(tmp_path / "scans.mcap", longer, turn.to_bytes() + bytes(4), definition=own)
    recording = read_recording(rosbag(tmp_path, "commands.mcap", "scans.mcap"))
    assert recording.commands[0].tolist() == [[0.15, -0.5]] * 2
    np.testing.assert_array_equal(recording.ranges, [turn.ranges] * 2)
    np.testing.assert_array_equal(recording.stamp, [START] * 2)


SENSORS = {
    ("breezyslam_exp1_urg_odom", "/scan"): (756, 682),
    ("rplidar_c1_lab446a", "/scan"): (10, 1440),
    ("urg04lx_obstacle_detector_demo", "/rear_scan"): (330, 726),
    ("urg04lx_obstacle_detector_demo", "/scan"): (331, 726),
    ("urg_legs_positive_7", "/scan"): (510, 768),
}


@pytest.mark.parametrize(("name", "topic"), SENSORS)
def test_recordings_of_real_sensors_are_read_as_another_library_reads_them(name, topic):
    path = REAL / f"{name}.mcap"
    if not path.is_file():
        pytest.skip("the recordings of real sensors lie beside the repository only")
    recording = read_recording(path, scan=topic, strict=True)
    assert recording.ranges.shape == SENSORS[name, topic]
    assert np.isfinite(recording.poses()).all()
    assert (recording.odometry is not None) == ("odom" in name)
    assert (np.diff(recording.seconds) > 0).all()
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        sources = [source for source in reader.connections if source.topic == topic]
        turns = [reader.deserialize(data, source.msgtype) for source, _, data in reader.messages(sources)]
    for row, turn in zip(recording.ranges, turns, strict=True):
        came_back = (turn.ranges >= turn.range_min) & (turn.ranges <= turn.range_max)
        np.testing.assert_array_equal(row, np.where(came_back, turn.ranges, np.inf))
