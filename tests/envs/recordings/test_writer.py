"""Writing recordings: other readers read them, and the same messages make the same bytes."""

import numpy as np
import pytest
from drives import SCAN, TWIST, drive, scan
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from coil_rl.envs.recordings.cdr import encode
from coil_rl.envs.recordings.mcap_files import read_messages
from coil_rl.envs.recordings.ros_messages import Twist
from coil_rl.envs.recordings.writer import RecordingWriter

MARKERS = "visualization_msgs/msg/MarkerArray"


def write(path, turn):
    with RecordingWriter(path) as writer:
        writer.describe("coil", {"input": "1f2e", "config": "3a4b"})
        writer.attach("config.yaml", "application/yaml", b"seed: 0\n")
        for time in range(3)[::turn]:
            writer.add("/cmd_vel", TWIST, time=time, data=Twist(time, 0).to_bytes())
            cones = {"markers": [{"ns": "left", "pose": {"orientation": {"w": 1.0}}}]}
            writer.add(
                "/coil/cones",
                "visualization_msgs/msg/MarkerArray",
                time=time,
                data=encode("visualization_msgs/msg/MarkerArray", cones),
            )
    return path.read_bytes()


def test_same_messages_make_the_same_bytes_in_whatever_order_they_come(tmp_path):
    assert write(tmp_path / "a.mcap", 1) == write(tmp_path / "b" / "c.mcap", -1)
    assert [file.name for file in (tmp_path / "b").iterdir()] == ["c.mcap"]


def test_another_reader_reads_what_was_written(tmp_path):
    path = drive(tmp_path / "a.mcap", scans=200, odometry=True, commands=True)
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        assert reader.message_count == 600
        assert sorted(reader.topics) == ["/cmd_vel", "/odom", "/scan"]
        scans = [source for source in reader.connections if source.topic == "/scan"]
        for turn, (source, time, data) in enumerate(reader.messages(scans)):
            message = reader.deserialize(data, source.msgtype)
            assert time == scan(turn).stamp
            np.testing.assert_array_equal(message.ranges, scan(turn).ranges)
        assert turn == 199


def test_metadata_and_attachments_are_found_again(tmp_path):
    write(tmp_path / "a.mcap", 1)
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        [metadata], [attachment] = reader.iter_metadata(), reader.iter_attachments()
    assert (metadata.name, metadata.metadata) == ("coil", {"input": "1f2e", "config": "3a4b"})
    assert (attachment.name, attachment.data) == ("config.yaml", b"seed: 0\n")


def test_messages_are_copied_as_they_stand(tmp_path):
    read = read_messages(drive(tmp_path / "a.mcap", scans=5, commands=True))
    with RecordingWriter(tmp_path / "b.mcap") as writer:
        for message in [message for topic in read.messages.values() for message in topic]:
            writer.copy(message)
    assert read_messages(tmp_path / "b.mcap") == read
    assert (tmp_path / "b.mcap").read_bytes() == (tmp_path / "a.mcap").read_bytes()


def test_nothing_is_written_where_something_goes_wrong(tmp_path):
    def fail():
        with RecordingWriter(tmp_path / "a.mcap") as writer:
            writer.add("/scan", SCAN, time=0, data=scan(0).to_bytes())
            writer.add("/scan", "LaserScan", time=0, data=b"")

    with pytest.raises(ValueError, match="no message type 'LaserScan'"):
        fail()
    assert not list(tmp_path.iterdir())
