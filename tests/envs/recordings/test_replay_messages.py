"""What a replay brought is found in a recording of its own, beside what was recorded, by any reader."""

import math

import numpy as np
import pytest
import torch
from drives import drive
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from coil_rl.envs import McapReplayEnv, RecordingWriter, read_recording
from coil_rl.envs.recordings.mcap_files import read_messages
from coil_rl.envs.recordings.replay_messages import add_sight, add_steering, copy_topics
from coil_rl.guides import SplineGuide

SCANS = 6


def perception(ranges, angles):
    """A row of three cones to either side; the left ones come in scan 2, the right ones go in scan 4."""
    cones = np.zeros((len(ranges), 2, 16, 2))
    cones[:, 0, :3], cones[:, 1, :3] = [[2, 2], [3, 2], [4, 2.5]], [[2, -1], [3, -1], [4, -1]]
    count = np.full((len(ranges), 2), 3)
    count[:2, 0] = 0
    count[4:, 1] = 1
    return cones, count


def replay(folder, name, **options):
    """A recording, and one with its scans and what a guide made of them."""
    source = drive(folder / "drive.mcap", SCANS, odometry=True, commands=True)
    env = McapReplayEnv(source, perception)
    with torch.no_grad():
        seen = env.rollout(SCANS, SplineGuide())[0]
    [recording] = env.recordings
    steering = seen["action"].squeeze(-1).numpy() * math.radians(80)
    omega = seen["next", "omega"].squeeze(-1).numpy()
    view = (seen[key].numpy() for key in ("cones", "cone_count", "observation", ("info", "valid")))
    with RecordingWriter(folder / name) as writer:
        copy_topics(writer, source, ["/scan", "/odom", "/tf"])
        add_steering(writer, "spline", recording.log_time, steering, omega, speed=0.15)
        add_sight(writer, recording.log_time, *view, frame="base_link", **options)
    return source, folder / name, steering, omega


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return replay(tmp_path_factory.mktemp("replay"), "replay.mcap")


@pytest.fixture(scope="module")
def read(made):
    return by_another_library(made[1])


def by_another_library(path):
    """The messages of each topic, and their times."""
    found, times = {}, {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for source, time, data in reader.messages():
            found.setdefault(source.topic, []).append(reader.deserialize(data, source.msgtype))
            times.setdefault(source.topic, []).append(time)
    return found, times


def test_everything_has_the_times_of_the_scans(read):
    found, times = read
    topics = ["/coil/boundary", "/coil/cones", "/coil/spline/cmd_vel", "/coil/spline/steering", "/coil/valid"]
    assert sorted(found) == [*topics, "/odom", "/scan"]
    assert all(times[topic] == times["/scan"] for topic in topics)
    assert len(times["/scan"]) == SCANS


def test_recorded_topics_are_copied_byte_for_byte(made):
    source, path, *_ = made
    topics = ["/scan", "/odom"]
    assert read_messages(path, topics).messages == read_messages(source, topics).messages


def test_steering_and_command_are_those_of_the_policy(made, read):
    *_, steering, omega = made
    assert [message.data for message in read[0]["/coil/spline/steering"]] == pytest.approx(steering.tolist())
    commands = read[0]["/coil/spline/cmd_vel"]
    assert [message.angular.z for message in commands] == pytest.approx(omega.tolist())
    assert {message.linear.x for message in commands} == {0.15}
    assert omega.tolist() == pytest.approx((0.15 / (2 / 7) * np.sin(steering)).tolist(), abs=1e-6)
    assert np.abs(omega[2:]).max() > 0.01


def test_cones_stand_where_they_were_perceived_yellow_left_and_blue_right(read):
    for scan, message in enumerate(read[0]["/coil/cones"]):
        first, *cones = message.markers
        assert first.action == 3, "what the scan before had shown goes"
        left, right = ([cone for cone in cones if cone.ns == side] for side in ("left", "right"))
        assert (len(left), len(right)) == (0 if scan < 2 else 3, 1 if scan >= 4 else 3)
        places = [(cone.pose.position.x * 7, cone.pose.position.y * 7) for cone in right]
        np.testing.assert_allclose(places, [(2, -1), (3, -1), (4, -1)][: len(right)], atol=1e-6)
        assert all(cone.color.r > cone.color.b and cone.color.g > cone.color.b for cone in left)
        assert all(cone.color.b > max(cone.color.r, cone.color.g) for cone in right)
        assert {marker.header.frame_id for marker in message.markers} == {"base_link"}


def test_boundary_runs_along_the_cones_and_fades_while_it_is_remembered(read):
    for scan, message in enumerate(read[0]["/coil/boundary"]):
        lines = {line.ns: line for line in message.markers[1:]}
        assert set(lines) == ({"right"} if scan < 2 else {"left", "right"}), "what was never seen is not drawn"
        points = [(point.x * 7, point.y * 7) for point in lines["right"].points]
        np.testing.assert_allclose(points, [(x, -1) for x in (2, 2.5, 3, 3.5, 4)], atol=1e-5)
        assert (lines["right"].color.a == 1) == (scan < 4)
    assert [message.data for message in read[0]["/coil/valid"]] == [False, False, True, True, False, False]


def test_markers_lie_on_the_scan_of_a_lidar_that_looks_to_the_left(made, read, tmp_path):
    turned, _ = by_another_library(replay(tmp_path, "turned.mcap", laser_yaw=math.radians(90))[1])
    for topic in ("/coil/cones", "/coil/boundary"):
        for straight, left in zip(read[0][topic], turned[topic], strict=True):
            for one, other in zip(straight.markers[1:], left.markers[1:], strict=True):
                for a, b in zip(one.points or [one.pose.position], other.points or [other.pose.position], strict=True):
                    # Ahead of the car is to the right of such a LiDAR.
                    assert (b.x, b.y) == pytest.approx((a.y, -a.x), abs=1e-6)


def test_note_that_a_recording_is_simulated_comes_along(tmp_path):
    source = drive(tmp_path / "drive.mcap", SCANS)
    for note in ({}, {"simulated": {"sensor": "none"}, "rosbag2": {"topics": "others"}}):
        with RecordingWriter(source) as writer:
            copy_topics(writer, source, ["/scan"])
            for name, entries in note.items():
                writer.describe(name, entries)
        with RecordingWriter(tmp_path / "copy.mcap") as writer:
            copy_topics(writer, source, ["/scan"])
        assert read_messages(tmp_path / "copy.mcap").notes == {k: v for k, v in note.items() if k == "simulated"}
        assert read_recording(source).simulated == bool(note)


def test_same_replay_makes_the_same_bytes(made, tmp_path):
    assert replay(tmp_path, "again.mcap")[1].read_bytes() == made[1].read_bytes()
