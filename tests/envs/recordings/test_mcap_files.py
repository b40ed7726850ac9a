"""Writing of recordings and encoding of messages."""

import numpy as np
import pytest
from drives import by_another_library, drive, scan
from mcap.reader import make_reader

from coil_rl.envs.recordings.mcap_files import RecordingWriter
from coil_rl.envs.recordings.messages import SCAN, TWIST, decode, encode, header, twist

MARKERS = "visualization_msgs/msg/MarkerArray"
MARKER = {
    "ns": "left",
    "header": header(1_500_000_001, "laser"),
    "pose": {"orientation": {"w": 1.0}},
}


def write(path, order):
    with RecordingWriter(path) as writer:
        writer.describe("coil", {"input": "1f2e", "config": "3a4b"})
        writer.attach("config.yaml", "application/yaml", b"seed: 0\n")
        for time in range(3)[::order]:
            writer.add("/cmd_vel", TWIST, time, twist(time, 0))
            writer.add("/coil/cones", MARKERS, time, {"markers": [MARKER]})
    return path.read_bytes()


def test_equal_messages_make_equal_bytes_in_any_order(tmp_path):
    assert write(tmp_path / "a.mcap", 1) == write(tmp_path / "b" / "c.mcap", -1)
    assert [file.name for file in (tmp_path / "b").iterdir()] == ["c.mcap"]


def test_another_reader_reads_messages_metadata_and_attachments(tmp_path):
    path = drive(tmp_path / "a.mcap", scans=200, odometry=True, commands=True)
    messages, _ = by_another_library(path)
    numbers = {topic: len(of_topic) for topic, of_topic in messages.items()}
    assert numbers == {"/cmd_vel": 200, "/odom": 200, "/scan": 200}
    for number, message in enumerate(messages["/scan"]):
        np.testing.assert_array_equal(message.ranges, scan(number)["ranges"])
    write(tmp_path / "b.mcap", 1)
    with (tmp_path / "b.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        [metadata], [attachment] = reader.iter_metadata(), reader.iter_attachments()
    assert (metadata.name, metadata.metadata) == ("coil", {"input": "1f2e", "config": "3a4b"})
    assert (attachment.name, attachment.data) == ("config.yaml", b"seed: 0\n")


def test_nothing_is_written_if_the_block_raises(tmp_path):
    def fail():
        with RecordingWriter(tmp_path / "a.mcap") as writer:
            writer.add("/scan", SCAN, 0, scan(0))
            writer.add("/scan", "LaserScan", 0, {})

    with pytest.raises(ValueError, match="'LaserScan' is not a standard ROS 2 message type"):
        fail()
    assert not list(tmp_path.iterdir())


def test_missing_fields_are_zero_or_empty():
    [marker, empty] = decode(encode(MARKERS, {"markers": [MARKER, {}]}), MARKERS).markers
    stamp = marker.header.stamp
    assert (marker.ns, stamp.sec, stamp.nanosec) == ("left", 1, 500_000_001)
    assert (empty.ns, empty.pose.position.x, len(empty.points)) == ("", 0.0, 0)


def test_unknown_fields_are_refused():
    with pytest.raises(ValueError, match=r"no field \['speed'\]; it has linear, angular"):
        encode(TWIST, {"speed": 1.0})
