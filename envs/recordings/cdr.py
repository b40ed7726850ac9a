"""ROS 2 messages as bytes: the definitions of their types, and CDR, the encoding that follows from them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np

LITTLE_ENDIAN = b"\x00\x01\x00\x00"

# Type: its fields in order, as ROS 2 Humble and later have them.
_TYPES = """
builtin_interfaces/Duration: int32 sec, uint32 nanosec
builtin_interfaces/Time: int32 sec, uint32 nanosec
geometry_msgs/Point: float64 x, float64 y, float64 z
geometry_msgs/Pose: geometry_msgs/Point position, geometry_msgs/Quaternion orientation
geometry_msgs/PoseWithCovariance: geometry_msgs/Pose pose, float64[36] covariance
geometry_msgs/Quaternion: float64 x, float64 y, float64 z, float64 w
geometry_msgs/Twist: geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular
geometry_msgs/TwistWithCovariance: geometry_msgs/Twist twist, float64[36] covariance
geometry_msgs/Vector3: float64 x, float64 y, float64 z
nav_msgs/Odometry: std_msgs/Header header, string child_frame_id, geometry_msgs/PoseWithCovariance pose,
    geometry_msgs/TwistWithCovariance twist
sensor_msgs/CompressedImage: std_msgs/Header header, string format, uint8[] data
sensor_msgs/LaserScan: std_msgs/Header header, float32 angle_min, float32 angle_max, float32 angle_increment,
    float32 time_increment, float32 scan_time, float32 range_min, float32 range_max, float32[] ranges,
    float32[] intensities
std_msgs/Bool: bool data
std_msgs/ColorRGBA: float32 r, float32 g, float32 b, float32 a
std_msgs/Float64: float64 data
std_msgs/Header: builtin_interfaces/Time stamp, string frame_id
visualization_msgs/Marker: std_msgs/Header header, string ns, int32 id, int32 type, int32 action,
    geometry_msgs/Pose pose, geometry_msgs/Vector3 scale, std_msgs/ColorRGBA color,
    builtin_interfaces/Duration lifetime, bool frame_locked, geometry_msgs/Point[] points, std_msgs/ColorRGBA[] colors,
    string texture_resource, sensor_msgs/CompressedImage texture, visualization_msgs/UVCoordinate[] uv_coordinates,
    string text, string mesh_resource, visualization_msgs/MeshFile mesh_file, bool mesh_use_embedded_materials
visualization_msgs/MarkerArray: visualization_msgs/Marker[] markers
visualization_msgs/MeshFile: string filename, uint8[] data
visualization_msgs/UVCoordinate: float32 u, float32 v
"""

_FIELDS = {
    line.split(": ")[0]: {name: kind for kind, name in (field.split() for field in line.split(": ")[1].split(", "))}
    for line in re.sub(r",\s+", ", ", _TYPES).strip().split("\n")
}
_NUMBERS = {
    "bool": np.dtype("?"),
    "uint8": np.dtype("u1"),
    "int32": np.dtype("<i4"),
    "uint32": np.dtype("<u4"),
    "float32": np.dtype("<f4"),
    "float64": np.dtype("<f8"),
}


@cache
def definition(kind: str) -> bytes:
    """The text that a recording keeps beside the messages of a type, with the types of which it is made.

    Args:
        kind: such as "sensor_msgs/msg/LaserScan".

    Raises:
        ValueError: for a type that is not known here, naming those that are.
    """
    name = _known(kind)
    parts = [_lines(name)] + [f"{'=' * 80}\nMSG: {part}\n{_lines(part)}" for part in dict.fromkeys(_parts(name))]
    return "".join(parts).encode()


def encode(kind: str, message: Mapping[str, Any]) -> bytes:
    """A message as bytes.

    Args:
        kind: such as "geometry_msgs/msg/Twist".
        message: field to number, text, sequence or another such mapping; what is left out is zero or empty.

    Raises:
        ValueError: for a type or a field that does not exist, or an array of another length.
    """
    out = bytearray()
    _put(out, _known(kind), message)
    return LITTLE_ENDIAN + bytes(out)


def decode(kind: str, data: bytes) -> dict[str, Any]:
    """The inverse of `encode`; arrays of numbers become NumPy arrays.

    Raises:
        ValueError: if the bytes are in another byte order, or fewer or more than a message of this type has.
    """
    check_byte_order(data)
    message: dict[str, Any]
    message, end = _take(data[4:], 0, _known(kind))
    check_length(data, 4 + end)
    return message


def check_byte_order(data: bytes) -> None:
    """Refuse what is not little-endian CDR.

    Raises:
        ValueError: saying how the message begins.
    """
    if data[:2] != LITTLE_ENDIAN[:2]:
        raise ValueError(
            f"it begins with the bytes {data[:4].hex(' ') or '(none)'}, not 00 01 as little-endian CDR does"
        )


def check_length(data: bytes, expected: int) -> None:
    """Refuse a message that is not as long as the lengths in it say.

    Raises:
        ValueError: with both.
    """
    if len(data) != expected:
        compared = "shorter" if len(data) < expected else "longer"
        raise ValueError(f"it has {len(data)} bytes, which is {compared} than the {expected} that its lengths say")


def _known(kind: str) -> str:
    name = kind.replace("/msg/", "/")
    if name not in _FIELDS or name == kind:
        known = ", ".join(name.replace("/", "/msg/") for name in _FIELDS)
        raise ValueError(f"there is no message type {kind!r} here; there are {known}")
    return name


def _lines(name: str) -> str:
    return "".join(f"{kind} {field}\n" for field, kind in _FIELDS[name].items())


def _parts(name: str) -> Iterator[str]:
    for kind in _FIELDS[name].values():
        part = kind.split("[")[0]
        if part in _FIELDS:
            yield part
            yield from _parts(part)


def _put(out: bytearray, kind: str, value: Any) -> None:
    if kind in _NUMBERS:
        _put_numbers(out, kind, [0 if value is None else value])
    elif kind == "string":
        text = (value or "").encode() + b"\x00"
        _put_numbers(out, "uint32", [len(text)])
        out += text
    elif kind.endswith("]"):
        element, size = kind[:-1].split("[")
        values = np.zeros(int(size or 0)) if value is None else value
        if not size:
            _put_numbers(out, "uint32", [len(values)])
        elif len(values) != int(size):
            raise ValueError(f"{kind} takes {size} numbers, not {len(values)}")
        if element in _NUMBERS:
            _put_numbers(out, element, values)
        else:
            for item in values:
                _put(out, element, item)
    else:
        message, fields = value or {}, _FIELDS[kind]
        if unknown := set(message) - set(fields):
            raise ValueError(f"{kind} has no field {sorted(unknown)}; it has {', '.join(fields)}")
        for field, inner in fields.items():
            _put(out, inner, message.get(field))


def _put_numbers(out: bytearray, kind: str, values: Any) -> None:
    if len(values):
        numbers = np.asarray(values, _NUMBERS[kind])
        out += bytes(-len(out) % numbers.itemsize) + numbers.tobytes()


def _take(data: bytes, start: int, kind: str) -> tuple[Any, int]:
    """What stands from a place on, and where it ends."""
    if kind in _NUMBERS:
        numbers, end = _take_numbers(data, start, kind, 1)
        return numbers[0].item(), end
    if kind == "string":
        length, start = _take(data, start, "uint32")
        return data[start : start + length].rstrip(b"\x00").decode(), start + length
    if kind.endswith("]"):
        element, size = kind[:-1].split("[")
        count, start = (int(size), start) if size else _take(data, start, "uint32")
        if element in _NUMBERS:
            return _take_numbers(data, start, element, count)
        items = []
        for _ in range(count):
            item, start = _take(data, start, element)
            items.append(item)
        return items, start
    message = {}
    for field, inner in _FIELDS[kind].items():
        message[field], start = _take(data, start, inner)
    return message, start


def _take_numbers(data: bytes, start: int, kind: str, count: int) -> tuple[Any, int]:
    numbers = _NUMBERS[kind]
    start += -start % numbers.itemsize if count else 0
    end = start + count * numbers.itemsize
    if end > len(data):
        raise ValueError(f"it has {4 + len(data)} bytes, which is shorter than the {4 + end} that its lengths say")
    return np.frombuffer(data, numbers, count, start), end
