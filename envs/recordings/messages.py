"""ROS 2 messages in CDR, encoded and decoded with the type store of rosbags.

A recording stores the definition of each message type. rosbags turns definitions into code, so a
forged one may take any time and memory. The types that are read here are standard ones: of a
definition only the fields of the message itself are used, and only if they differ from the standard
ones and are simple.
"""

import math
import re
from collections.abc import Collection, Mapping
from functools import cache, lru_cache
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

# Of a definition that comes with a recording.
LARGEST_DEFINITION = 100_000  # bytes
MOST_FIELDS = 100
LARGEST_ARRAY = 1000  # numbers
# Name of a type, which may be an array; name of the field; perhaps a default value.
FIELD = re.compile(r"([A-Za-z][\w/]{0,99}(?:\[\d{0,4}\])?)[ \t]+([a-z]\w{0,99})(?:[ \t].*)?")
CONSTANT = re.compile(r"[a-z]\w*(?:<=\d+)?[ \t]+[A-Za-z]\w*[ \t]*=.*")
NUMBERS = frozenset(
    ["bool", "byte", "char", "float32", "float64"]
    + [f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)]
)


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


def decode(data: bytes, message_type: str, language: str = "ros2msg", text: bytes = b"") -> Any:
    """Return a message in CDR of either byte order, with its fields as attributes.

    Args:
        data: the message; bytes that are not a message of this type are a `SerdeError`.
        message_type: such as "geometry_msgs/msg/Twist".
        language: of the definition; one in another language than "ros2msg" is left out.
        text: the definition that is stored with the message; the standard one is used instead if it
            is empty, cannot be parsed, or has other fields than numbers, short arrays of numbers,
            texts, and the standard parts of the type.
    """
    return _types_of(message_type, language, text).deserialize_cdr(data, message_type)


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


@lru_cache(maxsize=16)
def _types_of(message_type: str, language: str, text: bytes) -> Typestore:
    """Return the types of a definition, or the standard ones if it is not to be used."""
    if language != "ros2msg" or not 0 < len(text) <= LARGEST_DEFINITION:
        return ros_types()
    parts = get_types_from_msg(definition(message_type).decode(), message_type)
    try:
        fields = _simple_fields(text.decode(), list(parts))
        own = get_types_from_msg("\n".join(fields), message_type)
        if own[message_type][1] == parts[message_type][1]:
            return ros_types()
        types = get_typestore(Stores.EMPTY)
        types.register(parts | own)
        types.get_msgdef(message_type)
    except Exception:  # the text may be anything
        return ros_types()
    return types


def _simple_fields(text: str, parts: Collection[str]) -> list[str]:
    """Return a line for each field of a definition; a `ValueError` for one that is not simple.

    Args:
        text: the definition; its sections after the first one define parts and are left out.
        parts: names of the types that a field may have besides numbers and texts.
    """
    section = re.split(r"^=+[ \t]*$", text, maxsplit=1, flags=re.MULTILINE)[0]
    lines = [line.partition("#")[0].strip() for line in section.splitlines()]
    simple = []
    for line in filter(None, lines):
        if CONSTANT.fullmatch(line):
            continue
        field = FIELD.fullmatch(line)
        if field is None:
            raise ValueError(f"{line!r:.100} is not the definition of a field")
        simple.append(f"{field[1]} {field[2]}")
        kind, _, size = field[1].partition("[")
        short = int(size.removesuffix("]") or 0) <= LARGEST_ARRAY
        part = any(
            each.replace("/msg/", "/").endswith(kind.replace("/msg/", "/")) for each in parts
        )
        if not (kind in NUMBERS and short) and not ((kind == "string" or part) and not size):
            raise ValueError(f"{line!r:.100} has another type than is read here")
    if len(simple) > MOST_FIELDS:
        raise ValueError(f"there are {len(simple)} fields")
    return simple


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
