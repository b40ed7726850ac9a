"""Recordings of a robot, made for tests, and their messages as another library reads them."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags import rosbag2
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores, get_typestore
from tensordict import TensorDict

from coil_rl.envs import read_recording, simulated_drive
from coil_rl.envs.recordings.mcap_files import Channel, RawMessage, RecordingWriter
from coil_rl.envs.recordings.messages import (
    ODOMETRY,
    SCAN,
    TWIST,
    definition,
    encode,
    header,
    ros_types,
    twist,
)
from coil_rl.guides import SplineGuide

REAL = Path(__file__).parents[2] / "shared" / "recordings"
# Recordings of real sensors in rooms without cones, and their topics. Numbers of scans, of their
# ranges, of clusters within 1.15 m and of those with at least two points, and the share of the
# clusters in sight that are rejected.
SENSORS = {
    ("breezyslam_exp1_urg_odom", "/scan"): (756, 682, 3241, 2817, 0.50),
    ("rplidar_c1_lab446a", "/scan"): (2, 1440, 17, 17, 0.50),  # of the first of five scanners
    ("urg04lx_obstacle_detector_demo", "/rear_scan"): (330, 726, 1955, 1926, 0.14),
    ("urg04lx_obstacle_detector_demo", "/scan"): (331, 726, 722, 719, 0.57),
    ("urg_legs_positive_7", "/scan"): (510, 768, 1247, 1229, 0.85),
}
PERIOD = 182_000_000  # ns
START = 1_700_000_000_000_000_000  # ns


def scan(number, points=360, seed=0, **changed):
    """A LaserScan of an RPLIDAR, with random ranges of which some are missing."""
    draw = np.random.default_rng([seed, number])
    ranges = (draw.integers(600, 12_000, points) * 0.00025).astype(np.float32)
    ranges[draw.random(points) < 0.1] = np.inf
    points = len(changed.get("ranges", ranges))
    increment = 2 * 3.1241 / max(1, len(ranges) - 1)
    fields = {
        "angle_min": -3.1241,
        "angle_max": -3.1241 + increment * max(0, points - 1),
        "angle_increment": increment,
        "range_min": 0.15,
        "range_max": 12.0,
    }
    return fields | {"header": header(START + number * PERIOD, "laser"), "ranges": ranges} | changed


def odometry_fields(stamp, x, y, heading):
    """An Odometry message."""
    pose = {
        "position": {"x": x, "y": y},
        "orientation": {"z": np.sin(heading / 2), "w": np.cos(heading / 2)},
    }
    return {"header": header(stamp, "odom"), "pose": {"pose": pose}}


def drive(path, scans=60, odometry=False, commands=False, seed=0):
    """A recording on a circle of radius 1 m at 0.15 m/s, anticlockwise from the origin."""
    with RecordingWriter(path) as writer:
        for number in range(scans):
            time, angle = START + number * PERIOD, 0.15 * number * PERIOD / 1e9
            writer.add("/scan", SCAN, time, scan(number, seed=seed))
            if odometry:
                writer.add(
                    "/odom",
                    ODOMETRY,
                    time,
                    odometry_fields(time, np.sin(angle), 1 - np.cos(angle), angle),
                )
            if commands:
                writer.add("/cmd_vel", TWIST, time, twist(0.15, 0.15))
    return path


def labelling_drives(seeds):
    """Simulated drives past the left cones alone and past the right ones, a pair for each seed."""
    return [simulated_drive(side, seed) for seed in seeds for side in ("left", "right")]


def store(path, *messages, kind=SCAN, topic="/scan", **channel):
    """A recording of messages, given as fields or as bytes, a second apart."""
    standard = definition(kind) if kind in (SCAN, ODOMETRY, TWIST) else b"float64 data\n"
    with RecordingWriter(path) as writer:
        for second, message in enumerate(messages):
            time = START + second * 10**9
            data = message if isinstance(message, bytes) else encode(kind, message)
            writer.copy(
                RawMessage(
                    Channel(topic, kind, **({"definition": standard} | channel)), time, time, data
                )
            )
    return path


def rosbag_of(folder, *messages, latched=()):
    """A recording by the writer of rosbags.

    It is made of messages with topic, type, time and fields, and has the latched topics.
    """
    transient = QosDurability.TRANSIENT_LOCAL
    always = QosTime(2147483647, 4294967295)
    qos = Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        transient,
        always,
        always,
        QosLiveliness.AUTOMATIC,
        always,
        False,
    )
    topics = {}
    with rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        for topic, kind, time, fields in messages:
            if topic not in topics:
                profiles = [qos] if topic in latched else []
                topics[topic] = writer.add_connection(
                    topic, kind, typestore=ros_types(), offered_qos_profiles=profiles
                )
            writer.write(topics[topic], time, encode(kind, fields))
    return folder


def by_another_library(path):
    """The messages of each topic, and their times in ns."""
    messages, times = {}, {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for channel, time, data in reader.messages():
            messages.setdefault(channel.topic, []).append(reader.deserialize(data, channel.msgtype))
            times.setdefault(channel.topic, []).append(time)
    return messages, times


def blind(ranges, angles):
    """Perception without cones."""
    return np.zeros((len(ranges), 2, 16, 2)), np.zeros((len(ranges), 2))


class SplineDriver:
    """The spline guide as an object with `act` and `reset`, as a policy of somebody else."""

    def reset(self):
        pass

    def act(self, observation):
        data = {key: torch.as_tensor(value)[None] for key, value in observation.items()}
        return SplineGuide()(TensorDict(data, [1]))["action"][0].numpy()


def real_recording(name, topic):
    """The recording of a real sensor, see `SENSORS`."""
    path = REAL / f"{name}.mcap"
    if not path.is_file():
        pytest.skip("the recordings of real sensors are not part of the repository")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return read_recording(path, scan=topic, strict=True)


def uncompressed(path):
    """The same recording in chunks that are not compressed, the default of ROS 2."""
    with path.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages())
    with path.open("wb") as stream:
        writer = Writer(stream, 128 * 1024, CompressionType.NONE)
        writer.start("ros2")
        channels = {}
        for schema, channel, message in messages:
            if channel.topic not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, kind
                )
            writer.add_message(
                channels[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return path
