"""What a robot's recording says: turns of its scanner, where it was, and how it was told to move.

Each message is read from CDR at places that follow from a few lengths in it, many times as fast as by its definition.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.recordings.cdr import check_byte_order, check_length, encode

_HEADER = struct.Struct("<iII")  # s, ns, bytes of the text that follows
_COUNT = struct.Struct("<I")
_SCAN = struct.Struct("<7fI")
_POSE = struct.Struct("<7d")
_TWIST = struct.Struct("<6d")
_COVARIANCE = 36 * 8

_Read = TypeVar("_Read")


class LaserScan(NamedTuple):
    """A turn of a scanner, `sensor_msgs/msg/LaserScan`; its intensities are left out.

    Attributes:
        stamp: ns, when it began.
        angle_min: radians, of the first range.
        angle_increment: radians, from one range to the next.
        range_min: m, nothing nearer is a return.
        range_max: m, nothing farther is one.
        ranges: [P] m.
        scan_time: s, of a turn.
        frame: what the angles are relative to.
    """

    stamp: int
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    scan_time: float = 0.0
    frame: str = "laser"

    def to_bytes(self) -> bytes:
        """As CDR."""
        points = len(self.ranges)
        fields = {
            "header": header(self.stamp, self.frame), "angle_min": self.angle_min,
            "angle_max": self.angle_min + self.angle_increment * (points - 1), "angle_increment": self.angle_increment,
            "time_increment": self.scan_time / max(points, 1), "scan_time": self.scan_time,
            "range_min": self.range_min, "range_max": self.range_max, "ranges": self.ranges,
        }  # fmt: skip
        return encode("sensor_msgs/msg/LaserScan", fields)


class Odometry(NamedTuple):
    """Where the robot is in the plane, `nav_msgs/msg/Odometry`.

    Attributes:
        stamp: ns.
        x: m.
        y: m.
        heading: radians.
        speed: m/s, ahead.
        turn_rate: radians/s.
        frame: of the pose.
    """

    stamp: int
    x: float
    y: float
    heading: float
    speed: float = 0.0
    turn_rate: float = 0.0
    frame: str = "odom"

    def to_bytes(self) -> bytes:
        """As CDR."""
        turned = {"z": math.sin(self.heading / 2), "w": math.cos(self.heading / 2)}
        fields = {
            "header": header(self.stamp, self.frame),
            "child_frame_id": "base_link",
            "pose": {"pose": {"position": {"x": self.x, "y": self.y}, "orientation": turned}},
            "twist": {"twist": {"linear": {"x": self.speed}, "angular": {"z": self.turn_rate}}},
        }
        return encode("nav_msgs/msg/Odometry", fields)


class Twist(NamedTuple):
    """How the robot is told to move, `geometry_msgs/msg/Twist`.

    Attributes:
        speed: m/s, ahead.
        turn_rate: radians/s.
    """

    speed: float
    turn_rate: float

    def to_bytes(self) -> bytes:
        """As CDR."""
        return encode("geometry_msgs/msg/Twist", {"linear": {"x": self.speed}, "angular": {"z": self.turn_rate}})


def header(stamp: int, frame: str) -> dict[str, Any]:
    """A `std_msgs/msg/Header` for `encode`; the stamp in ns."""
    sec, nanosec = divmod(stamp, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def decoder(kind: str) -> Callable[[bytes], LaserScan | Odometry | Twist]:
    """What reads a message of a type from CDR; it raises ValueError if the bytes are not such a message."""
    return _DECODERS[kind]


def from_fields(kind: str, message: Any) -> LaserScan | Odometry | Twist:
    """The same from a message whose fields are attributes, as other libraries decode it."""
    if kind == "geometry_msgs/msg/Twist":
        return Twist(message.linear.x, message.angular.z)
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    if kind == "nav_msgs/msg/Odometry":
        place, way, twist = message.pose.pose.position, message.pose.pose.orientation, message.twist.twist
        turned = heading(way.x, way.y, way.z, way.w)
        return Odometry(stamp, place.x, place.y, turned, twist.linear.x, twist.angular.z, message.header.frame_id)
    return LaserScan(
        stamp,
        message.angle_min,
        message.angle_increment,
        message.range_min,
        message.range_max,
        np.asarray(message.ranges, np.float32),
        message.scan_time,
        message.header.frame_id,
    )


def heading(x: float, y: float, z: float, w: float) -> float:
    """The turn about the vertical that a quaternion makes, radians."""
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _checked(read: Callable[[bytes], _Read]) -> Callable[[bytes], _Read]:
    def checked(data: bytes) -> _Read:
        check_byte_order(data)
        try:
            return read(data)
        except struct.error:
            raise ValueError(f"it has {len(data)} bytes, which is shorter than its lengths say") from None

    return checked


def _laser_scan(data: bytes) -> LaserScan:
    stamp, frame, place = _header(data)
    place += -place % 4
    angle_min, _, increment, _, scan_time, range_min, range_max, points = _SCAN.unpack_from(data, place)
    place += _SCAN.size
    end = place + 4 * points
    (intensities,) = _COUNT.unpack_from(data, end)
    check_length(data, end + 4 + 4 * intensities)
    ranges = np.frombuffer(data, "<f4", points, place)
    return LaserScan(stamp, angle_min, increment, range_min, range_max, ranges, scan_time, frame)


def _odometry(data: bytes) -> Odometry:
    stamp, frame, place = _header(data)
    place += -place % 4
    (length,) = _COUNT.unpack_from(data, place)
    place += 4 + length
    place += (4 - place) % 8  # what is aligned to eight bytes counts from behind the four of the byte order
    x, y, _, *turned = _POSE.unpack_from(data, place)
    place += _POSE.size + _COVARIANCE
    speed, _, _, _, _, turn_rate = _TWIST.unpack_from(data, place)
    check_length(data, place + _TWIST.size + _COVARIANCE)
    return Odometry(stamp, x, y, heading(*turned), speed, turn_rate, frame)


def _twist(data: bytes) -> Twist:
    check_length(data, 4 + _TWIST.size)
    speed, _, _, _, _, turn_rate = _TWIST.unpack_from(data, 4)
    return Twist(speed, turn_rate)


def _header(data: bytes) -> tuple[int, str, int]:
    sec, nanosec, length = _HEADER.unpack_from(data, 4)
    end = 4 + _HEADER.size + length
    return sec * 10**9 + nanosec, data[4 + _HEADER.size : end].rstrip(b"\x00").decode("utf-8", "replace"), end


_DECODERS: dict[str, Callable[[bytes], Any]] = {
    "sensor_msgs/msg/LaserScan": _checked(_laser_scan),
    "nav_msgs/msg/Odometry": _checked(_odometry),
    "geometry_msgs/msg/Twist": _checked(_twist),
}
