"""ROS 2 messages in CDR, encoded and decoded with the type store of rosbags.

The types that are read here are standard ones. The definitions that a recording stores are not
used: rosbags turns them into code, so a forged one may take any time and memory.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
ACKERMANN = "ackermann_msgs/msg/AckermannDrive"
ACKERMANN_STAMPED = "ackermann_msgs/msg/AckermannDriveStamped"
COMMANDS = (TWIST, TWIST_STAMPED, ACKERMANN, ACKERMANN_STAMPED)

# Types that the store of rosbags lacks.
_OWN_TYPES = {
    ACKERMANN: """float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
""",
    ACKERMANN_STAMPED: """std_msgs/Header header
ackermann_msgs/AckermannDrive drive
""",
}


@cache
def ros_types() -> Typestore:
    """Return the standard message types, with those of commands to cars."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in _OWN_TYPES.items():
        types.register(get_types_from_msg(text, name))
    return types


@cache
def definition(message_type: str) -> bytes:
    """Return the definition of a type and its parts as in a recording.

    Args:
        message_type: name of a standard type, else a `ValueError`.
    """
    _fields_of(message_type)
    return ros_types().generate_msgdef(message_type, ros_version=2)[0].encode()


def encode(message_type: str, fields: Mapping[str, Any]) -> bytes:
    """Return a message as little-endian CDR.

    Args:
        message_type: such as "geometry_msgs/msg/Twist".
        fields: by name, each a number, text, sequence or nested mapping; zero or empty if missing.
            An unknown field is a `ValueError`.
    """
    message = _message(message_type, fields)
    return bytes(ros_types().serialize_cdr(message, message_type, little_endian=True))


def decode(data: bytes, message_type: str) -> Any:
    """Return a message in CDR of either byte order, with its fields as attributes.

    Args:
        data: the message; bytes that are not a message of this type are a `SerdeError`.
        message_type: such as "geometry_msgs/msg/Twist".
    """
    return ros_types().deserialize_cdr(data, message_type)


def twist(speed: float, turn_rate: float) -> dict[str, Any]:
    """Return the fields of a Twist; forward speed in m/s, turn rate in radians/s."""
    return {"linear": {"x": speed}, "angular": {"z": turn_rate}}


def header(stamp: int, frame: str) -> dict[str, Any]:
    """Return the fields of a Header; the stamp in ns."""
    sec, nanosec = divmod(stamp, 10**9)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame}


def stamp_of(message: Any) -> int:
    """Return the stamp of a message with a header, in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def pose_of(message: Any) -> tuple[float, float, float]:
    """Return the pose of an Odometry message in the plane: m, m, radians."""
    position, q = message.pose.pose.position, message.pose.pose.orientation
    return (
        position.x,
        position.y,
        math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)),
    )


def command_of(message: Any) -> tuple[float, float]:
    """Return the two numbers of a command, a message of one of `COMMANDS`.

    They are the forward speed in m/s, and the turn rate in radians/s or, of the Ackermann types,
    the steering angle in radians.
    """
    for name in ("twist", "drive"):
        message = getattr(message, name, message)
    if hasattr(message, "steering_angle"):
        return message.speed, message.steering_angle
    return message.linear.x, message.angular.z


def _fields_of(message_type: str) -> dict[str, Any]:
    """Return the fields of a standard type, each with the description of its type by rosbags."""
    if message_type not in ros_types().fielddefs:
        raise ValueError(
            f"{message_type!r} is not a standard ROS 2 message type; give one such as {SCAN}"
        )
    return dict(ros_types().fielddefs[message_type][1])


def _message(message_type: str, fields: Mapping[str, Any]) -> Any:
    """Return a message as an object of rosbags."""
    kinds = _fields_of(message_type)
    unknown = set(fields) - set(kinds)
    if unknown:
        raise ValueError(
            f"{message_type} has no field {sorted(unknown)}; it has {', '.join(kinds)}"
        )
    message_class: Any = ros_types().types[message_type]
    return message_class(**{name: _value(kind, fields.get(name)) for name, kind in kinds.items()})


def _value(description: Any, value: Any) -> Any:
    """Return the value of a field, zero or empty for None; the description is that of rosbags."""
    node, kind = description
    if node == Nodetype.BASE:
        if value is not None:
            return value
        return "" if kind[0] == "string" else 0
    if node == Nodetype.NAME:
        return _message(kind, value or {})
    (element, element_kind), size = kind
    if element == Nodetype.BASE and element_kind[0] != "string":
        return np.asarray(np.zeros(size) if value is None else value, element_kind[0])
    return [_value((element, element_kind), item) for item in value or ()]
