"""Reading of recordings, and one-sentence errors for those that cannot be used."""

import hashlib
import re
import warnings

import numpy as np
import pytest
from drives import (
    PERIOD,
    SENSORS,
    START,
    by_another_library,
    drive,
    odometry_fields,
    real_recording,
    rosbag_of,
    scan,
    store,
    uncompressed,
)
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.convert.cli import main as convert

from coil_rl.envs.recordings.folders import RecordingError
from coil_rl.envs.recordings.mcap_files import Channel, RawMessage, RecordingWriter, digest
from coil_rl.envs.recordings.messages import (
    COMMANDS,
    ODOMETRY,
    SCAN,
    TWIST,
    definition,
    encode,
    header,
    twist,
)
from coil_rl.envs.recordings.reading import read_recording

EITHER_COMPRESSION = pytest.mark.parametrize(
    "compression", [lambda path: path, uncompressed], ids=["zstd", "none"]
)
ANGLE = 0.15 * np.arange(300) * PERIOD / 1e9
SCANS = [("/scan", SCAN, START + number * PERIOD, scan(number)) for number in range(3)]
CIRCLE = np.stack([np.sin(ANGLE), 1 - np.cos(ANGLE), ANGLE], axis=1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Several chunks of scans, odometry and commands; not to be written to."""
    path = tmp_path_factory.mktemp("drives") / "whole.mcap"
    return drive(path, scans=300, odometry=True, commands=True)


def ranges_of(numbers):
    return [scan(number)["ranges"] for number in numbers]


def copy(path, folder, share=1.0):
    """A copy of the first bytes of a file."""
    data, made = path.read_bytes(), folder / path.name
    made.write_bytes(data[: int(share * len(data))])
    return made


def rosbag(folder, *files, storage="mcap"):
    """Make a folder a rosbag2 recording of the given files."""
    lines = "".join(f"    - {file}\n" for file in files)
    text = f"  storage_identifier: {storage}\n  relative_file_paths:\n{lines}  message_count: 1\n"
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  version: 5\n{text}")
    return folder


def refusal(path, **options):
    """The message of the error, which is one sentence about the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RecordingError) as caught:
            read_recording(path, **options)
    message = str(caught.value)
    assert message.startswith(str(path.parent))
    assert message.endswith(".")
    assert "\n" not in message
    return message


def test_scans_are_read_as_one_array(whole):
    recording = read_recording(whole)
    np.testing.assert_array_equal(recording.ranges, ranges_of(range(300)))
    assert recording.ranges.dtype == np.float32
    np.testing.assert_array_equal(recording.stamp, START + np.arange(300) * PERIOD)
    np.testing.assert_allclose(recording.angles(7), np.linspace(-3.1241, 3.1241, 360), atol=1e-4)
    np.testing.assert_allclose(recording.seconds, np.arange(300) * PERIOD / 1e9)
    assert (recording.frame, recording.remarks) == ("laser", [])


def test_missing_points_and_ranges_outside_the_scanners_limits_are_no_return(tmp_path):
    ranges = np.array([0.0, 0.1, 0.15, 1.0, 12.0, 12.5, np.nan, np.inf, -1.0], np.float32)
    scans = [scan(0, ranges=ranges), scan(1, 3), scan(2, 0)]
    recording = read_recording(store(tmp_path / "a.mcap", *scans))
    assert recording.points.tolist() == [9, 3, 0]
    expected = np.full((3, 9), np.inf, np.float32)
    expected[0, 2:5] = [0.15, 1.0, 12.0]
    expected[1, :3] = scans[1]["ranges"]
    np.testing.assert_array_equal(recording.ranges, expected)


def test_folder_of_split_files_is_one_recording_in_order_of_its_stamps(tmp_path):
    scans = [scan(number) for number in range(4)]
    store(tmp_path / "b.mcap", *scans[:2])
    store(tmp_path / "a.mcap", *scans[2:])
    store(tmp_path / "another.mcap", scans[0])
    # Both are logged from the same time on.
    with pytest.warns(UserWarning, match="log times that step back by 1 s, so stamps give"):
        recording = read_recording(rosbag(tmp_path, "drive/b.mcap", '"a.mcap"'))
    np.testing.assert_array_equal(recording.log_time - START, np.array([0, 1, 2, 3]) * 10**9)
    np.testing.assert_array_equal((recording.stamp - START) // PERIOD, [0, 1, 2, 3])
    with pytest.warns(UserWarning, match="stamps fall 2 times"):  # so the log times are the clock
        recording = read_recording(rosbag(tmp_path, "a.mcap", "b.mcap"))
    assert recording.seconds.tolist() == [0, 0, 1, 1]


def test_poses_are_interpolated_from_the_odometry(tmp_path, whole):
    np.testing.assert_allclose(read_recording(whole).poses(), CIRCLE, atol=1e-9)
    poses = [
        odometry_fields(START + 10**9, 2.0, 0.0, 3.1),
        odometry_fields(START + 3 * 10**9, 4.0, 1.0, -3.1),
    ]
    store(tmp_path / "odometry.mcap", *poses, kind=ODOMETRY, topic="/odom")
    scans = [scan(0, header=header(START + s * 10**9, "laser")) for s in range(5)]
    store(tmp_path / "scans.mcap", *scans)
    folder = rosbag(tmp_path, "odometry.mcap", "scans.mcap")
    first, last = [2, 0, 3.1], [4, 1, 2 * np.pi - 3.1]
    expected = [first, first, [3, 0.5, np.pi], last, last]
    np.testing.assert_allclose(read_recording(folder).poses(), expected)


def test_poses_without_odometry_are_integrated_from_the_commands(tmp_path, whole):
    np.testing.assert_allclose(read_recording(whole, odometry=None).poses(), CIRCLE, atol=1e-9)
    assert not read_recording(whole, odometry=None, command=None).poses().any()
    store(tmp_path / "scans.mcap", *[scan(0)] * 4)
    twists = [twist(1.0, 0.0), twist(2.0, 0.0), twist(0.0, 0.5)]
    store(tmp_path / "commands.mcap", *twists, kind=TWIST, topic="/cmd_vel")
    folder = rosbag(tmp_path, "scans.mcap", "commands.mcap")
    expected = [[0, 0, 0], [1, 0, 0], [3, 0, 0], [3, 0, 0.5]]
    np.testing.assert_allclose(read_recording(folder).poses(), expected)


def test_digest_is_that_of_all_files_in_their_order(tmp_path):
    parts = [store(tmp_path / f"{name}.mcap", scan(number)) for number, name in enumerate("ab")]
    expected = hashlib.sha256(parts[0].read_bytes() + parts[1].read_bytes()).hexdigest()
    assert digest(rosbag(tmp_path, "a.mcap", "b.mcap")) == expected
    assert digest(rosbag(tmp_path, "b.mcap", "a.mcap")) != expected
    assert digest(parts[0]) == hashlib.sha256(parts[0].read_bytes()).hexdigest()
    with pytest.raises(RecordingError, match="No such file"):
        digest(tmp_path / "missing.mcap")


OTHER_FORMATS = ["drive.bag --dst-typestore ros1_noetic", "drive --dst-storage sqlite3"]


@pytest.mark.parametrize("wanted", OTHER_FORMATS)
def test_command_in_the_error_message_converts_a_recording_to_mcap(tmp_path, monkeypatch, wanted):
    def run(command):
        monkeypatch.setattr("sys.argv", command.split())
        with pytest.raises(SystemExit, match="0"):
            convert()

    source = rosbag_of(tmp_path / "source", *SCANS)
    run(f"rosbags-convert --src {source} --dst {tmp_path}/{wanted}")
    path = tmp_path / wanted.split()[0]
    remedy = re.search(r"rosbags-convert .*mcap", refusal(path))[0]
    run(re.sub("FILE|FOLDER", str(path), remedy).replace("OTHER", str(tmp_path / "new")))
    np.testing.assert_array_equal(read_recording(tmp_path / "new").ranges, ranges_of(range(3)))


def test_messages_of_either_byte_order_are_read(tmp_path):
    little_endian = encode(TWIST, twist(0.15, -0.5))
    big_endian = b"\0\0\0\0" + np.frombuffer(little_endian, "<f8", 6, 4).astype(">f8").tobytes()
    store(tmp_path / "commands.mcap", little_endian, big_endian, kind=TWIST, topic="/cmd_vel")
    store(tmp_path / "scans.mcap", scan(0), scan(1))
    recording = read_recording(rosbag(tmp_path, "commands.mcap", "scans.mcap"))
    assert recording.commands[0].tolist() == [[0.15, -0.5]] * 2


OTHER_FILES = {
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


@pytest.mark.parametrize(("reason", "data"), OTHER_FILES.items(), ids=list(OTHER_FILES))
def test_other_files_are_refused(tmp_path, reason, data):
    (tmp_path / "drive.mcap").write_bytes(data)
    assert reason in refusal(tmp_path / "drive.mcap")


def test_missing_files_and_incomplete_folders_are_refused(tmp_path):
    assert "No such file" in refusal(tmp_path / "missing.mcap")
    store(tmp_path / "drive_0.mcap", scan(0))
    assert "folder without a readable metadata.yaml" in refusal(tmp_path)
    assert "rosbags-convert" in refusal(rosbag(tmp_path, "drive_0.db3", storage="sqlite3"))
    assert "lists no files" in refusal(rosbag(tmp_path))
    (tmp_path / "metadata.yaml").write_text("- [no: metadata")
    assert "folder without a readable metadata.yaml" in refusal(tmp_path)
    topic = "topic_and_type: {name: /scan}"  # as the first versions of ROS 2 wrote it
    text = f"relative_file_paths: [drive_0.mcap], topics_with_message_count: [{{{topic}}}]"
    (tmp_path / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {{{text}}}")
    assert len(read_recording(tmp_path).ranges) == 1


def test_recording_that_is_cut_off_is_read_as_far_as_it_goes(tmp_path, whole):
    path = copy(whole, tmp_path, 0.6)
    with pytest.warns(UserWarning, match=r"whole\.mcap is cut off: \d+ scans can be read"):
        recording = read_recording(path)
    scans = len(recording.ranges)
    assert recording.remarks == [f"is cut off: {scans} scans can be read"]
    assert 120 < scans < 180
    np.testing.assert_array_equal(recording.ranges, ranges_of(range(scans)))
    assert f"is cut off: {scans} scans can be read; copy it again" in refusal(path, strict=True)
    assert "cut off before its first scan" in refusal(copy(whole, tmp_path, 0.01))


@pytest.mark.slow
@EITHER_COMPRESSION
def test_recording_may_be_cut_off_anywhere(tmp_path, whole, compression):
    path = compression(copy(whole, tmp_path))
    data = path.read_bytes()
    for size in [*range(1, 130), *range(130, len(data), 49_973), *range(len(data) - 60, len(data))]:
        path.write_bytes(data[:size])
        assert "cut off" in refusal(path, strict=True)


@pytest.mark.fast(6)
@EITHER_COMPRESSION
@pytest.mark.parametrize("place", ["content", "length", "end"])
@pytest.mark.parametrize("damaged", [[0], [1], [-1], [0, 1, 2]], ids=str)
def test_readable_chunks_of_a_damaged_recording_are_read(
    tmp_path, whole, compression, damaged, place
):
    path = compression(copy(whole, tmp_path))
    with path.open("rb") as stream:
        index = make_reader(stream).get_summary().chunk_indexes
    data, scans = bytearray(path.read_bytes()), set(range(300))
    for chunk in (index[number] for number in damaged):
        start, end = chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length
        if place == "content":
            data[(start + end) // 2] ^= 1
        else:
            at = start if place == "length" else end - 30
            data[at : at + 60] = bytes(60)
        start, end = chunk.message_start_time, chunk.message_end_time
        scans -= {n for n in scans if start <= START + n * PERIOD <= end}
    path.write_bytes(data)
    lost = 300 - len(scans)
    assert lost
    words = rf"whole\.mcap is damaged at byte \d+: {300 - lost} scans .*, {lost} are lost"
    with pytest.warns(UserWarning, match=words):
        recording = read_recording(path)
    np.testing.assert_array_equal(recording.ranges, ranges_of(sorted(scans)))
    assert f"{lost} are lost; copy it again" in refusal(path, strict=True)


def test_number_of_lost_scans_is_unknown_without_an_index(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        options = {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False}
        writer = Writer(stream, 4000, CompressionType.NONE, index_types=IndexType.NONE, **options)
        writer.start("ros2")
        schema = writer.register_schema(SCAN, "ros2msg", definition(SCAN))
        channel = writer.register_channel("/scan", "cdr", schema)
        for number in range(9):
            writer.add_message(channel, START + number * PERIOD, encode(SCAN, scan(number)), 0)
        writer.finish()
    data = bytearray(path.read_bytes())
    data[data.find(encode(SCAN, scan(4))) + 100] ^= 1
    path.write_bytes(data)
    with pytest.warns(UserWarning, match=r"\d scans can be read, an unknown number are lost"):
        recording = read_recording(path)
    kept = ((recording.stamp - START) // PERIOD).tolist()
    assert {0, 8} < set(kept) < set(range(9)) - {4}
    np.testing.assert_array_equal(recording.ranges, ranges_of(kept))


def test_damage_that_no_chunk_explains_is_refused(tmp_path, whole):
    path = copy(whole, tmp_path)
    with path.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[1]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length + 30] ^= 1  # the index after the chunk
    path.write_bytes(data)
    assert re.search("is damaged before byte .*crc validation failed.*mcap recover", refusal(path))
    path.write_bytes(
        data[:8] + b"\1" + (2**40).to_bytes(8, "little") + data[17:-36] + bytes(28) + data[-8:]
    )
    assert "is damaged before byte 17 (" in refusal(path)


@pytest.mark.parametrize("index", [True, False])
def test_chunks_of_an_unknown_compression_are_no_damage(tmp_path, index):
    path = drive(tmp_path / "a.mcap", scans=2)
    data = path.read_bytes()
    assert data.count(b"zstd") == 2  # of the chunk, and of its entry in the index
    path.write_bytes(data.replace(b"zstd", b"blsc", 2 if index else 1))
    if index:
        assert "has chunks in the compression 'blsc', but zstd and lz4 are read" in refusal(path)
    else:
        assert "is damaged before its first scan" in refusal(path)


@pytest.mark.fast(1)
@EITHER_COMPRESSION
def test_damage_anywhere_is_found_or_harmless(tmp_path, compression):
    path = compression(drive(tmp_path / "a.mcap", scans=9, commands=True))
    expected, data = read_recording(path), path.read_bytes()
    draw = np.random.default_rng(0)
    beginning, end = range(8, 120), range(len(data) - 60, len(data))
    for place in [*beginning, *draw.integers(120, len(data), 200), *end]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << draw.integers(8)
        path.write_bytes(damaged)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a damaged index may name another type of a topic
                recording = read_recording(path, strict=True)
        except RecordingError:
            continue
        np.testing.assert_array_equal(recording.ranges, expected.ranges)
        np.testing.assert_array_equal(recording.commands[0], expected.commands[0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scan": "/front"}, "has no topic /front; give the topic of the LiDAR, here /scan"),
        (
            {"scan": "/odom", "odometry": None},
            f"on topic /odom, not of {SCAN} in cdr; give the topic",
        ),
        ({"scan": "/odom"}, "must be different topics"),
    ],
)
def test_wrong_topics_are_refused_and_the_right_one_is_named(whole, options, words):
    assert words in refusal(whole, **options)


def test_recording_without_scans_is_refused(tmp_path):
    path = store(tmp_path / "a.mcap", twist(0, 0), kind=TWIST, topic="/cmd_vel")
    assert "has no scans of a LiDAR" in refusal(path)
    assert "its topics are: /cmd_vel;" in refusal(path)
    assert "its topics are: none" in refusal(store(tmp_path / "b.mcap"))
    assert "no scan has a range" in refusal(store(tmp_path / "c.mcap", scan(0, 0), scan(1, 0)))


@pytest.mark.parametrize(
    ("channel", "found"),
    [
        ({"encoding": "json"}, f"{SCAN} in json"),
        ({"encoding": ""}, f"{SCAN} in no encoding"),
        ({"kind": ""}, "no type in cdr"),
    ],
)
def test_other_encodings_and_types_are_refused(tmp_path, channel, found):
    words = f"has messages of {found} on topic /scan, not of {SCAN} in cdr; record the scans"
    assert words in refusal(store(tmp_path / "a.mcap", b"{}", **channel))


@pytest.mark.parametrize(
    ("topic", "kind", "words"),
    [
        ("/odom", "geometry_msgs/msg/PoseStamped", f"not of {ODOMETRY} in cdr"),
        ("/cmd_vel", "geometry_msgs/msg/Vector3", f"not of {' or '.join(COMMANDS)} in cdr"),
    ],
)
def test_other_types_of_odometry_or_commands_are_ignored_with_a_warning(
    tmp_path, topic, kind, words
):
    path = rosbag_of(tmp_path / "drive", *SCANS, (topic, kind, START, {}))
    words = f"drive has messages of {kind} in cdr on topic {topic}, {words}, and they are ignored"
    with pytest.warns(UserWarning, match=re.escape(words) + "$"):
        recording = read_recording(path, strict=True)
    assert len(recording.remarks) == 1
    assert len(recording.ranges) == 3
    assert (recording.odometry, recording.commands) == (None, None)


def scanners(path, *, frames=("front", "rear"), ranges=(12.0, 12.0), senders=("", "")):
    """Scans of two scanners in turn on one topic: in the even and odd places."""
    with RecordingWriter(path) as writer:
        for number in range(7):
            of = number % 2
            time = START + number * PERIOD
            fields = scan(number, header=header(time, frames[of]), range_max=ranges[of])
            sender = (("callerid", senders[of]),)
            channel = Channel("/scan", SCAN, definition=definition(SCAN), metadata=sender)
            writer.copy(RawMessage(channel, time, time, encode(SCAN, fields)))
    return path


def test_of_several_scanners_on_a_topic_the_chosen_one_is_read(tmp_path):
    path = scanners(tmp_path / "a.mcap")
    words = r"of which the first is read: front \(4 scans.*, rear \(3 .*frame=NAME$"
    with pytest.warns(UserWarning, match=words):
        first = read_recording(path)
    assert (first.frame, len(first.ranges)) == ("front", 4)
    for frame, odd in (("front", 0), ("rear", 1)):
        recording = read_recording(path, frame=frame)
        assert (recording.frame, recording.remarks) == (frame, [])
        np.testing.assert_array_equal(recording.ranges, ranges_of(range(odd, 7, 2)))
        np.testing.assert_array_equal(recording.log_time, START + np.arange(odd, 7, 2) * PERIOD)
    words = "has no scan with the frame left; give frame=front or rear."
    assert words in refusal(path, frame="left")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"ranges": (12.0, 4.0)}, r"laser \(4 scans to 12 m\), laser \(3 scans to 4 m\)"),
        ({"senders": ("/a", "/b")}, r"laser of /a \(4 scans.*, laser of /b \(3 scans"),
    ],
)
def test_scanners_with_the_same_frame_are_distinguished(tmp_path, options, words):
    path = scanners(tmp_path / "a.mcap", frames=("laser", "laser"), **options)
    with pytest.warns(UserWarning, match=words + ".*; record each on a topic of its own$"):
        assert len(read_recording(path, frame="laser").ranges) == 4


# Speed of the commands, whether there is odometry, the speed of the robot by it, and the result.
DRIVEN = [
    (0.35, True, 0.2, 0.35),
    (0.0, True, -0.2, -0.2),  # backwards
    (0.0, False, 0.2, 0.15),
]


@pytest.mark.parametrize(("commanded", "odometry", "measured", "expected"), DRIVEN)
def test_speed_of_a_command_is_its_own_or_measured_or_nominal(
    tmp_path, commanded, odometry, measured, expected
):
    path = tmp_path / "drive.mcap"
    with RecordingWriter(path) as writer:
        for number in range(4):
            time = START + number * 10**9
            writer.add("/scan", SCAN, time, scan(number, header=header(time, "laser")))
            writer.add("/cmd_vel", TWIST, time + 1, twist(commanded, 0.1))
            if odometry:
                pose = odometry_fields(time, measured * number, 0, 0)
                writer.add("/odom", ODOMETRY, time, pose)
    commands = read_recording(path).commands_of_scans(0.15)
    np.testing.assert_allclose(commands, [[expected, 0.1]] * 4, rtol=1e-6)


@pytest.mark.parametrize("size", [0, 10, 1483])
def test_truncated_and_infinite_messages_are_refused(tmp_path, size):
    scans = [encode(SCAN, scan(number)) for number in range(3)]
    message = refusal(store(tmp_path / "a.mcap", scans[0], scans[1][:size], scans[2]))
    assert f"topic /scan, message 1 at 1700000001.000 s: it is not a valid {SCAN} (" in message
    assert "record it again" in message
    path = store(tmp_path / "a.mcap", scan(0), scan(1, angle_min=np.nan))
    assert "message 1 at 1700000001.000 s: the angle" in refusal(path)
    store(tmp_path / "b.mcap", odometry_fields(START, np.inf, 0, 0), kind=ODOMETRY, topic="/odom")
    store(tmp_path / "c.mcap", scan(0))
    assert "topic /odom, message 0" in refusal(rosbag(tmp_path, "b.mcap", "c.mcap"))


@pytest.mark.parametrize(("name", "topic"), SENSORS)
def test_recordings_of_real_sensors_are_read_like_another_library_does(name, topic):
    recording = real_recording(name, topic)
    assert recording.ranges.shape == SENSORS[name, topic][:2]
    assert np.isfinite(recording.poses()).all()
    assert (recording.odometry is not None) == ("odom" in name)
    assert (np.diff(recording.seconds) > 0).all()
    messages = by_another_library(recording.path)[0][topic]
    messages = [message for message in messages if message.header.frame_id == recording.frame]
    for row, message in zip(recording.ranges, messages, strict=True):
        in_range = (message.ranges >= message.range_min) & (message.ranges <= message.range_max)
        np.testing.assert_array_equal(row, np.where(in_range, message.ranges, np.inf))
