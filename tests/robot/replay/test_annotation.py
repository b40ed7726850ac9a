"""Annotated recordings, read by another library."""

import itertools
from functools import partial

import numpy as np
import pytest
from drives import PERIOD, START, by_another_library, drive, rosbag_of, scan
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from coil_rl.envs import McapReplayEnv
from coil_rl.envs.recordings.mcap_files import RecordingWriter, read_messages
from coil_rl.envs.recordings.messages import SCAN, header
from coil_rl.guides import SplineGuide
from coil_robot.replay.annotation import annotate
from coil_robot.replay.open_loop import open_loop

SCANS = 6


def perception(ranges, angles):
    """Three cones per side; the left ones appear in scan 2, the right ones disappear in scan 4."""
    cones = np.zeros((len(ranges), 2, 16, 2))
    cones[:, 0, :3], cones[:, 1, :3] = [[2, 2], [3, 2], [4, 2.5]], [[2, -1], [3, -1], [4, -1]]
    count = np.full((len(ranges), 2), 3)
    count[:2, 0] = 0
    count[4:, 1] = 1
    return cones, count


def annotate_replay(source, path, *, sight=None, perceive=perception, **options):
    """Write a recording with the replay of a guide."""
    env = McapReplayEnv(source, perceive, sight=sight)
    [result] = open_loop(env, {"spline": (env, SplineGuide())})
    usual = {"topics": ["/scan"], "about": {}, "attachments": {}}
    annotate(result, path, **usual | options)


def described(source, attachment=None, **notes):
    """Add metadata to a recording, and an attachment."""
    contents = read_messages(source)
    with RecordingWriter(source) as writer:
        for message in itertools.chain(*contents.messages.values()):
            writer.copy(message)
        for name, entries in notes.items():
            writer.describe(name, entries)
        if attachment:
            writer.attach(*attachment)
    return source


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    path = tmp_path_factory.mktemp("replay") / "drive.mcap"
    drive(path, SCANS, odometry=True, commands=True)
    return described(path, simulated={"about": "it"}, rosbag2={"about": "it"})


def test_markers_have_the_stamp_and_the_frame_of_the_scan(tmp_path):
    messages = []
    for number in range(SCANS):
        stamped = scan(number, header=header(7 + number * PERIOD, "lidar"))
        messages.append(("/scan", SCAN, START + number * PERIOD, stamped))
    path = tmp_path / "annotated.mcap"
    annotate_replay(rosbag_of(tmp_path / "drive", *messages), path)
    messages, times = by_another_library(path)
    for topic in ("/coil/cones", "/coil/boundary"):
        assert times[topic] == times["/scan"]
        for of_scan, message in zip(messages["/scan"], messages[topic], strict=True):
            assert all(marker.header == of_scan.header for marker in message.markers)


def test_copies_keep_the_qos_definitions_metadata_and_attachments(tmp_path):
    scans = [("/scan", SCAN, START + number * PERIOD, scan(number)) for number in range(SCANS)]
    transforms = [("/tf_static", "tf2_msgs/msg/TFMessage", START, {})]
    folder = rosbag_of(tmp_path / "drive", *scans, *transforms, latched=["/tf_static"])
    attachment = "calibration.yaml", "text/yaml", b"yaw: 0", (3, 5)
    source = described(next(folder.glob("*.mcap")), attachment, provenance={"sensor": "URG"})
    path = tmp_path / "annotated.mcap"
    annotate_replay(source, path, attachments={"config.yaml": b"seed: 0"})
    with AnyReader([source]) as original, AnyReader([path]) as copy:
        for topic in ("/scan", "/tf_static"):
            [one] = [each for each in original.connections if each.topic == topic]
            [other] = [each for each in copy.connections if each.topic == topic]
            assert (one.ext, one.msgdef, one.digest) == (other.ext, other.msgdef, other.digest)
        assert other.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert {"provenance", "coil"} == {record.name for record in reader.iter_metadata()}
        attached = {record.name: record for record in reader.iter_attachments()}
    assert set(attached) == {"calibration.yaml", "config.yaml"}
    copied = attached["calibration.yaml"]
    assert (copied.create_time, copied.log_time) == (3, 5)
    assert (copied.media_type, copied.data) == ("text/yaml", b"yaw: 0")


@pytest.fixture(scope="module")
def annotated(source):
    path = source.with_name("annotated.mcap")
    annotate_replay(source, path, topics=["/scan", "/odom"])
    return path


@pytest.fixture(scope="module")
def read(annotated):
    return by_another_library(annotated)


def test_messages_have_the_times_of_the_scans_and_recorded_topics_are_copied(
    annotated, read, source
):
    messages, times = read
    added = [f"/coil/{name}" for name in ("boundary", "cones", "spline/cmd_vel", "spline/steering")]
    added.append("/coil/valid")
    assert sorted(messages) == [*added, "/odom", "/scan"]
    assert all(times[topic] == times["/scan"] for topic in added)
    copied, original = (read_messages(path, ["/scan", "/odom"]) for path in (annotated, source))
    assert copied.messages == original.messages
    assert set(read_messages(annotated).notes) == {"simulated", "coil"}


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
    valid = [message.data for message in read[0]["/coil/valid"]]
    assert valid == [False, False, True, True, False, False]


def points_of(messages):
    """The points of all markers but the first, which deletes those of the scan before."""
    for message in messages:
        for marker in message.markers[1:]:
            yield from marker.points or [marker.pose.position]


def test_boundary_is_at_its_place_with_any_range_of_view(source, read, tmp_path):
    annotate_replay(source, tmp_path / "far.mcap", sight=11.2)
    far, _ = by_another_library(tmp_path / "far.mcap")
    near, wide = (points_of(messages["/coil/boundary"]) for messages in (read[0], far))
    for a, b in zip(near, wide, strict=True):
        assert (b.x, b.y) == pytest.approx((a.x, a.y), abs=1e-5)


@pytest.mark.parametrize("topic", ["/coil/cones", "/coil/boundary"])
def test_markers_are_in_the_frame_of_a_lidar_that_points_to_the_left(source, read, topic, tmp_path):
    to_the_left = partial(perception)
    to_the_left.laser_yaw = 90.0
    annotate_replay(source, tmp_path / "turned.mcap", perceive=to_the_left)
    turned, _ = by_another_library(tmp_path / "turned.mcap")
    for a, b in zip(points_of(read[0][topic]), points_of(turned[topic]), strict=True):
        assert (b.x, b.y) == pytest.approx((a.y, -a.x), abs=1e-6)
