"""What a replay brought, as messages that stand beside the recording's own: for Foxglove, RViz or a robot."""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.recordings.cdr import encode
from coil_rl.envs.recordings.mcap_files import read_messages
from coil_rl.envs.recordings.reading import SIMULATED
from coil_rl.envs.recordings.ros_messages import Twist, header
from coil_rl.envs.recordings.writer import RecordingWriter
from coil_rl.envs.sight import SAMPLES, SIGHT, WIDEST_ANGLE
from coil_rl.envs.track import SIDES

MARKERS, FLOAT, BOOL, TWIST = (
    "visualization_msgs/msg/MarkerArray",
    "std_msgs/msg/Float64",
    "std_msgs/msg/Bool",
    "geometry_msgs/msg/Twist",
)
CYLINDER, LINE_STRIP, DELETE_ALL = 3, 4, 3
COLOURS = {"left": {"r": 1.0, "g": 0.85}, "right": {"g": 0.3, "b": 1.0}}
DIAMETER = {"left": 0.04, "right": 0.09}  # m, of a cone
HEIGHT, LINE = 0.1, 0.01  # m
FADED = 0.3  # of the colour of a boundary that is only remembered

Floats = NDArray[np.floating]
Times = NDArray[np.int64]


def copy_topics(writer: RecordingWriter, path: str | os.PathLike[str], topics: Collection[str]) -> None:
    """Copy topics of a recording as they stand, and the note that it is simulated; what it does not have is left out.

    Raises:
        RecordingError: as `read_messages`.
    """
    contents = read_messages(path, topics)
    for messages in contents.messages.values():
        for message in messages:
            writer.copy(message)
    if SIMULATED in contents.notes:
        writer.describe(SIMULATED, contents.notes[SIMULATED])


def add_steering(
    writer: RecordingWriter, policy: str, log_time: Times, steering: Floats, omega: Floats, speed: float
) -> None:
    """Add what a policy would have done: `/coil/POLICY/steering` and `/coil/POLICY/cmd_vel`.

    Args:
        writer: of the recording to be.
        policy: its name.
        log_time: [N] ns, of the scans.
        steering: [N] radians, the angle chosen after each.
        omega: [N] radians/s, how fast that turns the robot.
        speed: m/s.
    """
    for time, angle, turn_rate in zip(log_time.tolist(), steering.tolist(), omega.tolist(), strict=True):
        writer.add(f"/coil/{policy}/steering", FLOAT, time=time, data=encode(FLOAT, {"data": angle}))
        writer.add(f"/coil/{policy}/cmd_vel", TWIST, time=time, data=Twist(speed, turn_rate).to_bytes())


def add_sight(
    writer: RecordingWriter,
    log_time: Times,
    cones: Floats,
    count: NDArray[np.integer],
    observation: Floats,
    valid: NDArray[np.bool_],
    *,
    frame: str = "laser",
    laser_yaw: float = 0.0,
    scale: float = 7.0,
    sight: float = SIGHT,
) -> None:
    """Add what every policy saw: `/coil/cones`, yellow left and blue right, `/coil/boundary` and `/coil/valid`.

    All of it is in the scanner's frame, so that it lies on the scan whatever else is known. A boundary that is only
    remembered is faded, and one that was never seen is left out. A scan is valid if both of its sides are.

    Args:
        writer: of the recording to be.
        log_time: [N] ns, of the scans.
        cones: [N, 2, K, 2] m times `scale`, in the car's frame.
        count: [N, 2], how many are real.
        observation: [N, 20], of which the boundaries are drawn.
        valid: [N, 2], whether each side was seen.
        frame: the name of the scanner's frame.
        laser_yaw: radians, the bearing of its 0 in the car's frame, anticlockwise.
        scale: metres of the simulation in one of the robot's.
        sight: m, the distance that is 1 in the observation.
    """
    back = np.array([[math.cos(laser_yaw), -math.sin(laser_yaw)], [math.sin(laser_yaw), math.cos(laser_yaw)]]) / scale
    lines, places = _boundaries(observation, sight) @ back, cones @ back
    known = np.logical_or.accumulate(valid, axis=0)
    for row, time in enumerate(log_time.tolist()):
        top = header(time, frame)
        found = [{"header": top, "action": DELETE_ALL}]
        drawn = [{"header": top, "action": DELETE_ALL}]
        for side, name in enumerate(SIDES):
            found += _cones(top, name, places[row, side, : count[row, side]])
            if known[row, side]:
                drawn.append(_line(top, name, lines[row, side], 1.0 if valid[row, side] else FADED))
        writer.add("/coil/cones", MARKERS, time=time, data=encode(MARKERS, {"markers": found}))
        writer.add("/coil/boundary", MARKERS, time=time, data=encode(MARKERS, {"markers": drawn}))
        writer.add("/coil/valid", BOOL, time=time, data=encode(BOOL, {"data": bool(valid[row].all())}))


def _cones(top: dict[str, Any], side: str, places: Floats) -> Iterator[dict[str, Any]]:
    size = {"x": DIAMETER[side], "y": DIAMETER[side], "z": HEIGHT}
    for number, (x, y) in enumerate(places.tolist()):
        pose = {"position": {"x": x, "y": y, "z": HEIGHT / 2}, "orientation": {"w": 1.0}}
        colour = COLOURS[side] | {"a": 1.0}
        yield {
            "header": top, "ns": side, "id": number, "type": CYLINDER, "pose": pose, "scale": size, "color": colour,
        }  # fmt: skip


def _line(top: dict[str, Any], side: str, points: Floats, opacity: float) -> dict[str, Any]:
    return {
        "header": top, "ns": side, "type": LINE_STRIP, "pose": {"orientation": {"w": 1.0}}, "scale": {"x": LINE},
        "color": COLOURS[side] | {"a": opacity}, "points": [{"x": x, "y": y} for x, y in points.tolist()],
    }  # fmt: skip


def _boundaries(observation: Floats, sight: float) -> Floats:
    """The inverse of `sight.encode`: [N, 2, 5, 2] m."""
    distance, angle = np.moveaxis(observation.reshape(len(observation), 2, SAMPLES, 2), -1, 0)
    distance, angle = (distance + 1) * (sight / 2), angle * WIDEST_ANGLE
    return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)
