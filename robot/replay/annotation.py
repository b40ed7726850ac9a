"""Annotated recordings, and a Foxglove layout for them.

An annotated recording is a copy with the steering of the policies and with the perceived cones.
"""

import json
import math
from collections.abc import Collection, Mapping
from importlib.resources import files
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.envs import SAMPLES, SIDES, WIDEST_ANGLE
from coil_rl.envs.recordings.mcap_files import RecordingWriter, digest, read_messages
from coil_rl.envs.recordings.messages import TWIST, TWIST_STAMPED, header, twist
from coil_rl.envs.robot import THICK, THIN
from coil_rl.report import style
from coil_robot.replay.open_loop import Floats, OpenLoop

MARKERS = "visualization_msgs/msg/MarkerArray"
FLOAT = "std_msgs/msg/Float64"
BOOL = "std_msgs/msg/Bool"
CYLINDER, LINE_STRIP = 3, 4  # types of a marker
DELETE_ALL = 3  # action of a marker
COLOURS = {"left": {"r": 1.0, "g": 0.85}, "right": {"g": 0.3, "b": 1.0}}
DIAMETERS = {"left": 2 * THIN, "right": 2 * THICK}  # m, of a cone
CONE_HEIGHT, LINE_WIDTH = 0.1, 0.01  # m
SCALE = 7.0  # of the cone world, to the metres of the paper's robot
FADED = 0.3  # opacity of a boundary from the memory

# Metadata record with the numbers of messages in the original, which the copy does not have
ROSBAG2 = "rosbag2"
TRANSFORMS = ("/tf", "/tf_static")
POLICY, SCAN, COMMAND = "POLICY", "/scan", "/cmd_vel"  # placeholders in the shipped layout


def annotate(
    result: OpenLoop,
    path: Path,
    *,
    topics: Collection[str],
    about: Mapping[str, str],
    attachments: Mapping[str, bytes],
) -> None:
    """Write a recording with the steering of each policy and the perceived cones and boundaries.

    Adds `/coil/POLICY/steering` (radians) and `/coil/POLICY/cmd_vel` per policy, `/coil/cones`
    (yellow left, blue right), `/coil/boundary` and `/coil/valid` (both sides valid), at the log
    times of the scans. Markers have the stamp and the frame of the scan. A boundary from the memory
    is faded. Metadata and attachments are copied. Equal results make equal bytes.

    Args:
        topics: of the recording, copied besides its transforms.
        about: entries of the metadata record `coil`, to which the SHA-256 of the recording is
            added.
        attachments: YAML files by name.

    Raises:
        RecordingError: if the recording can no longer be read.
    """
    recording, env = result.recording, result.env
    contents = read_messages(recording.path, [*topics, *TRANSFORMS])
    times = recording.log_time.tolist()
    with RecordingWriter(path) as writer:
        for message in chain.from_iterable(contents.messages.values()):
            writer.copy(message)
        for name, entries in contents.notes.items():
            if name != ROSBAG2:
                writer.describe(name, entries)
        for name, attachment in contents.attachments.items():
            created_and_logged = attachment.create_time, attachment.log_time
            writer.attach(name, attachment.media_type, attachment.data, created_and_logged)
        for policy in result.policies:
            steering = result.steering[policy]
            angles = steering.action * env.max_steering
            for time, angle, turn_rate in zip(
                times, angles.tolist(), steering.omega.tolist(), strict=True
            ):
                writer.add(f"/coil/{policy}/steering", FLOAT, time, {"data": angle})
                writer.add(f"/coil/{policy}/cmd_vel", TWIST, time, twist(env.speed, turn_rate))
        _add_view(writer, result)
        for name, content in attachments.items():
            writer.attach(name, "application/yaml", content)
        writer.describe("coil", {**about, "input_sha256": digest(recording.path)})


def _add_view(writer: RecordingWriter, result: OpenLoop) -> None:
    """Write what the car perceives at each scan: the cones and the boundaries as markers.

    A perception that does not say its `scale` and `laser_yaw` has those of the paper's robot.
    """
    perception = result.env.perception
    yaw = math.radians(getattr(perception, "laser_yaw", 0.0))
    cos, sin = math.cos(yaw), math.sin(yaw)
    to_laser = np.array([[cos, -sin], [sin, cos]]) / getattr(perception, "scale", SCALE)
    lines = _boundaries(result) @ to_laser
    cones = result.cones @ to_laser
    ever_valid = np.logical_or.accumulate(result.valid, axis=0)
    recording = result.recording
    for row, (time, stamp) in enumerate(
        zip(recording.log_time.tolist(), recording.stamp.tolist(), strict=True)
    ):
        top = header(stamp, recording.frame)
        cone_markers: list[dict[str, Any]] = [{"header": top, "action": DELETE_ALL}]
        line_markers: list[dict[str, Any]] = [{"header": top, "action": DELETE_ALL}]
        for side, name in enumerate(SIDES):
            cone_markers += _cone_markers(top, name, cones[row, side, : result.count[row, side]])
            if ever_valid[row, side]:
                opacity = 1.0 if result.valid[row, side] else FADED
                line_markers.append(_line_marker(top, name, opacity, lines[row, side]))
        writer.add("/coil/cones", MARKERS, time, {"markers": cone_markers})
        writer.add("/coil/boundary", MARKERS, time, {"markers": line_markers})
        writer.add("/coil/valid", BOOL, time, {"data": bool(result.both_valid[row])})


def _boundaries(result: OpenLoop) -> Floats:
    """Return the estimated boundaries at each of N scans, [N, 2, SAMPLES, 2] m in the car's frame.

    This is the inverse of `sight.encode_samples`. The scale is that of the cone world.
    """
    distance, angle = np.moveaxis(result.observation.reshape(-1, 2, SAMPLES, 2), -1, 0)
    distance, angle = (distance + 1) * (result.env.memory.sight / 2), angle * WIDEST_ANGLE
    return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=-1)


def _cone_markers(top: dict[str, Any], side: str, cones: Floats) -> list[dict[str, Any]]:
    """Return a cylinder for each cone of one side, [N, 2] m in the frame of the scan."""
    size = {"x": DIAMETERS[side], "y": DIAMETERS[side], "z": CONE_HEIGHT}
    markers = []
    for number, (x, y) in enumerate(cones.tolist()):
        position = {"x": x, "y": y, "z": CONE_HEIGHT / 2}
        pose = {"position": position, "orientation": {"w": 1.0}}
        markers.append(_marker(top, side, CYLINDER, 1.0, id=number, pose=pose, scale=size))
    return markers


def _line_marker(top: dict[str, Any], side: str, opacity: float, line: Floats) -> dict[str, Any]:
    """Return a line for the boundary of one side, [SAMPLES, 2] m in the frame of the scan."""
    points = [{"x": x, "y": y} for x, y in line.tolist()]
    pose, size = {"orientation": {"w": 1.0}}, {"x": LINE_WIDTH}
    return _marker(top, side, LINE_STRIP, opacity, pose=pose, scale=size, points=points)


def _marker(
    top: dict[str, Any], side: str, kind: int, opacity: float, **fields: Any
) -> dict[str, Any]:
    """Return a marker in the colour of a side; `fields` are those that depend on its kind."""
    return {
        "header": top,
        "ns": side,
        "type": kind,
        "color": COLOURS[side] | {"a": opacity},
        **fields,
    }


def foxglove_layout(result: OpenLoop, *, scan: str = SCAN) -> str:
    """Return the shipped Foxglove layout with the policies, frame and topics of a recording."""
    text = files("coil_robot.replay").joinpath("foxglove_layout.json").read_text(encoding="utf-8")
    layout: dict[str, Any] = json.loads(text)
    for name, panel in layout["configById"].items():
        if name.startswith("3D!"):
            # Old drivers write frames with a leading slash, Foxglove does not.
            panel["followTf"] = result.recording.frame.removeprefix("/")
            panel["topics"] = {
                scan if topic == SCAN else topic: value for topic, value in panel["topics"].items()
            }
        elif name.startswith("Plot!"):
            lines = []
            for path in panel["paths"]:
                lines += _plot_lines(path, result)
            panel["paths"] = lines
    return json.dumps(layout, indent=2) + "\n"


def _plot_lines(path: Mapping[str, Any], result: OpenLoop) -> list[dict[str, Any]]:
    """Return the lines for a path of the shipped layout.

    It is one line per policy, or the line of the recorded commands if they have turn rates.
    """
    if POLICY in path["value"]:
        lines = []
        for policy, stroke in style.strong_strokes(result.policies).items():
            value = path["value"].replace(POLICY, policy)
            lines.append({**path, "value": value, "label": policy, "color": stroke.colour})
        return lines
    recording = result.recording
    if recording.command_topic is None or recording.steered:
        return []
    stamped = recording.command_type == TWIST_STAMPED
    fields = f"{recording.command_topic}.twist" if stamped else recording.command_topic
    return [{**path, "value": path["value"].replace(COMMAND, fields)}]
