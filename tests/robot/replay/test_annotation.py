"""Annotated recordings, read by another library."""

import itertools
import math

import numpy as np
import pytest
from drives import PERIOD, START, drive, rosbag_of, scan
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from coil_rl.envs import McapReplayEnv
from coil_rl.envs.recordings.mcap_files import RecordingWriter, read_messages
from coil_rl.envs.recordings.messages import SCAN, header
from coil_rl.guides import SplineGuide
from coil_robot.replay.annotation import annotate
from coil_robot.replay.open_loop import open_loop

SCANS = 6
TOPICS = [
    "/coil/boundary",
    "/coil/cones",
    "/coil/spline/cmd_vel",
    "/coil/spline/steering",
    "/coil/valid",
]


def perception(ranges, angles):
    """Three cones per side; the left ones appear in scan 2, the right ones disappear in scan 4."""
    cones = np.zeros((len(ranges), 2, 16, 2))
    cones[:, 0, :3], cones[:, 1, :3] = [[2, 2], [3, 2], [4, 2.5]], [[2, -1], [3, -1], [4, -1]]
    count = np.full((len(ranges), 2), 3)
    count[:2, 0] = 0
    count[4:, 1] = 1
    return cones, count


def annotated(folder, name, notes=(), sight=None, **options):
    """The result of a guide, and the annotated recording."""
    source = drive(folder / "drive.mcap", SCANS, odometry=True, commands=True)
    contents = read_messages(source)
    with RecordingWriter(source) as writer:
        for messages in contents.messages.values():
            for message in messages:
                writer.copy(message)
        for note in notes:
            writer.describe(note, {"about": "it"})
    env = McapReplayEnv(source, perception, sight=sight)
    [result] = open_loop(env, {"spline": (env, SplineGuide())})
    options = {
        "topics": ["/scan", "/odom"],
        "speed": 0.15,
        "scale": 7.0,
        "about": {},
        "attachments": {},
    } | options
    annotate(result, folder / name, **options)
    return result, folder / name


def by_another_library(path):
    """The messages of each topic, and their times."""
    messages, times = {}, {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for channel, time, data in reader.messages():
            messages.setdefault(channel.topic, []).append(reader.deserialize(data, channel.msgtype))
            times.setdefault(channel.topic, []).append(time)
    return messages, times


def test_markers_have_the_stamp_and_the_frame_of_the_scan(tmp_path):
    messages = []
    for number in range(SCANS):
        stamped = scan(number, header=header(7 + number * PERIOD, "lidar"))
        messages.append(("/scan", SCAN, START + number * PERIOD, stamped))
    env = McapReplayEnv(rosbag_of(tmp_path / "drive", *messages), perception)
    [result] = open_loop(env, {"spline": (env, SplineGuide())})
    path = tmp_path / "annotated.mcap"
    annotate(result, path, topics=["/scan"], speed=0.15, scale=7.0, about={}, attachments={})
    messages, times = by_another_library(path)
    for topic in ("/coil/cones", "/coil/boundary"):
        assert times[topic] == times["/scan"]
        for of_scan, message in zip(messages["/scan"], messages[topic], strict=True):
            assert all(marker.header == of_scan.header for marker in message.markers)


def test_copies_keep_the_qos_definitions_metadata_and_attachments(tmp_path):
    scans = [("/scan", SCAN, START + number * PERIOD, scan(number)) for number in range(SCANS)]
    transforms = [("/tf_static", "tf2_msgs/msg/TFMessage", START, {})]
    source = next(
        rosbag_of(tmp_path / "drive", *scans, *transforms, latched=["/tf_static"]).glob("*.mcap")
    )
    contents = read_messages(source)
    with RecordingWriter(source) as writer:
        for message in itertools.chain(*contents.messages.values()):
            writer.copy(message)
        writer.describe("provenance", {"sensor": "URG"})
        writer.attach("calibration.yaml", "text/yaml", b"yaw: 0", (3, 5))
    env = McapReplayEnv(source, perception)
    [result] = open_loop(env, {"spline": (env, SplineGuide())})
    options = {"topics": ["/scan"], "speed": 0.15, "scale": 7.0, "about": {}}
    annotate(
        result, tmp_path / "annotated.mcap", **options, attachments={"config.yaml": b"seed: 0"}
    )
    with AnyReader([source]) as original, AnyReader([tmp_path / "annotated.mcap"]) as copy:
        for topic in ("/scan", "/tf_static"):
            [one], [other] = (
                [c for c in reader.connections if c.topic == topic] for reader in (original, copy)
            )
            assert (one.ext, one.msgdef, one.digest) == (other.ext, other.msgdef, other.digest)
        assert other.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
    with (tmp_path / "annotated.mcap").open("rb") as stream:
        reader = make_reader(stream)
        assert {"provenance", "coil"} == {record.name for record in reader.iter_metadata()}
        attached = {record.name: record for record in reader.iter_attachments()}
    assert set(attached) == {"calibration.yaml", "config.yaml"}
    copied = attached["calibration.yaml"]
    assert (copied.create_time, copied.log_time, copied.media_type, copied.data) == (
        3,
        5,
        "text/yaml",
        b"yaw: 0",
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return annotated(
        tmp_path_factory.mktemp("replay"), "annotated.mcap", notes=["simulated", "rosbag2"]
    )


@pytest.fixture(scope="module")
def read(made):
    return by_another_library(made[1])


def test_messages_have_the_times_of_the_scans_and_recorded_topics_are_copied(made, read):
    messages, times = read
    assert sorted(messages) == [*TOPICS, "/odom", "/scan"]
    assert all(times[topic] == times["/scan"] for topic in TOPICS)
    result, path = made
    topics = ["/scan", "/odom"]
    assert (
        read_messages(path, topics).messages
        == read_messages(result.recording.path, topics).messages
    )
    assert set(read_messages(path).notes) == {"simulated", "coil"}


def test_cones_are_at_their_positions_yellow_left_and_blue_right(read):
    for number, message in enumerate(read[0]["/coil/cones"]):
        first, *cones = message.markers
        assert first.action == 3, "deletes the markers of the scan before"
        left, right = ([cone for cone in cones if cone.ns == side] for side in ("left", "right"))
        assert (len(left), len(right)) == (0 if number < 2 else 3, 1 if number >= 4 else 3)
        positions = [(cone.pose.position.x * 7, cone.pose.position.y * 7) for cone in right]
        np.testing.assert_allclose(positions, [(2, -1), (3, -1), (4, -1)][: len(right)], atol=1e-6)
        assert all(cone.color.r > cone.color.b and cone.color.g > cone.color.b for cone in left)
        assert all(cone.color.b > max(cone.color.r, cone.color.g) for cone in right)
        assert {marker.header.frame_id for marker in message.markers} == {"laser"}


def test_remembered_boundary_is_faded_and_one_never_valid_is_missing(read):
    for number, message in enumerate(read[0]["/coil/boundary"]):
        lines = {line.ns: line for line in message.markers[1:]}
        assert set(lines) == ({"right"} if number < 2 else {"left", "right"})
        points = [(point.x * 7, point.y * 7) for point in lines["right"].points]
        np.testing.assert_allclose(points, [(x, -1) for x in (2, 2.5, 3, 3.5, 4)], atol=1e-5)
        assert (lines["right"].color.a == 1) == (number < 4)
    assert [message.data for message in read[0]["/coil/valid"]] == [
        False,
        False,
        True,
        True,
        False,
        False,
    ]


def test_boundary_is_at_its_place_with_any_range_of_view(read, tmp_path):
    far, _ = by_another_library(annotated(tmp_path, "far.mcap", sight=11.2)[1])
    for near, wide in zip(read[0]["/coil/boundary"], far["/coil/boundary"], strict=True):
        for one, other in zip(near.markers[1:], wide.markers[1:], strict=True):
            for a, b in zip(one.points, other.points, strict=True):
                assert (b.x, b.y) == pytest.approx((a.x, a.y), abs=1e-5)


def test_markers_are_in_the_frame_of_a_lidar_that_points_to_the_left(read, tmp_path):
    turned, _ = by_another_library(
        annotated(tmp_path, "turned.mcap", laser_yaw=math.radians(90))[1]
    )
    for topic in ("/coil/cones", "/coil/boundary"):
        for straight, left in zip(read[0][topic], turned[topic], strict=True):
            for one, other in zip(straight.markers[1:], left.markers[1:], strict=True):
                for a, b in zip(
                    one.points or [one.pose.position],
                    other.points or [other.pose.position],
                    strict=True,
                ):
                    assert (b.x, b.y) == pytest.approx((a.y, -a.x), abs=1e-6)
