"""Recordings of a robot that drives, made for tests."""

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from coil_rl.envs.recordings.cdr import definition
from coil_rl.envs.recordings.mcap_files import Source, Stored
from coil_rl.envs.recordings.ros_messages import LaserScan, Odometry, Twist
from coil_rl.envs.recordings.writer import RecordingWriter

TURN = 182_000_000  # ns
START = 1_700_000_000_000_000_000  # ns
SCAN, ODOMETRY, TWIST = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist"


def scan(turn, points=360, seed=0):
    """A turn of a scanner as an RPLIDAR gives it, with random ranges of which some are missing."""
    draw = np.random.default_rng([seed, turn])
    ranges = (draw.integers(600, 12_000, points) * 0.00025).astype(np.float32)
    ranges[draw.random(points) < 0.1] = np.inf
    return LaserScan(START + turn * TURN, -3.1241, 2 * 3.1241 / (points - 1), 0.15, 12.0, ranges, TURN / 1e9)


def drive(path, scans=60, odometry=False, commands=False, seed=0):
    """A recording on a circle of radius 1 m at 0.15 m/s, anticlockwise from the origin."""
    with RecordingWriter(path) as writer:
        for turn in range(scans):
            time, angle = START + turn * TURN, 0.15 * turn * TURN / 1e9
            writer.add("/scan", SCAN, time=time, data=scan(turn, seed=seed).to_bytes())
            if odometry:
                place = Odometry(time, np.sin(angle), 1 - np.cos(angle), angle, 0.15, 0.15)
                writer.add("/odom", ODOMETRY, time=time, data=place.to_bytes())
            if commands:
                writer.add("/cmd_vel", TWIST, time=time, data=Twist(0.15, 0.15).to_bytes())
    return path


def store(path, *messages, kind=SCAN, topic="/scan", **source):
    """A recording of messages given as bytes, a second apart."""
    known = definition(kind) if kind in (SCAN, ODOMETRY, TWIST) else b"float64 data\n"
    with RecordingWriter(path) as writer:
        for second, data in enumerate(messages):
            time = START + second * 10**9
            writer.copy(Stored(Source(topic, kind, **({"definition": known} | source)), time, time, data))
    return path


def uncompressed(path):
    """The same recording in chunks that are not compressed, as ROS 2 writes them unless told otherwise."""
    with path.open("rb") as stream:
        messages = list(make_reader(stream).iter_messages())
    with path.open("wb") as stream:
        writer = Writer(stream, 128 * 1024, CompressionType.NONE)
        writer.start("ros2")
        channels = {}
        for schema, channel, message in messages:
            if channel.topic not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, kind)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
    return path


def flipped(path, chunk=0):
    """The same recording with one bit turned in the middle of a chunk."""
    with path.open("rb") as stream:
        index = make_reader(stream).get_summary().chunk_indexes[chunk]
    data = bytearray(path.read_bytes())
    data[index.chunk_start_offset + index.chunk_length // 2] ^= 1
    path.write_bytes(data)
    return path
