"""The recording with what policies would have done beside it, as a file that stands alone and opens in Foxglove."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from coil_rl.envs.recordings.mcap_files import digest
from coil_rl.envs.recordings.replay_messages import add_sight, add_steering, copy_topics
from coil_rl.envs.recordings.writer import RecordingWriter
from coil_rl.replay.open_loop import RECORDED, OpenLoop
from coil_rl.report import style

TRANSFORMS = ("/tf", "/tf_static")
POLICY, SCAN, COMMAND = "POLICY", "/scan", "/cmd_vel"  # what stands in the layout that is shipped


def annotate(
    found: OpenLoop,
    path: Path,
    *,
    copied: Sequence[str],
    speed: float,
    scale: float,
    laser_yaw: float = 0.0,
    about: Mapping[str, str],
    attached: Mapping[str, bytes],
) -> None:
    """Write a recording with `/coil/POLICY/steering` and `cmd_vel` of each policy, and what they saw.

    The same replay makes the same bytes. A metadata record `coil` has the SHA-256 of the recording and what is given.

    Args:
        found: what was found in the recording.
        path: the MCAP file to be.
        copied: topics of the recording that come along, besides its transforms.
        speed: m/s of the robot, for the commands.
        scale: metres of the simulation in one of the robot's.
        laser_yaw: radians, the bearing of the LiDAR's 0 in the car's frame, anticlockwise.
        about: what to note there besides.
        attached: YAML files by name.

    Raises:
        RecordingError: if the recording can no longer be read.
    """
    recording = found.recording
    with RecordingWriter(path) as writer:
        copy_topics(writer, recording.path, [*copied, *TRANSFORMS])
        for policy in found.policies:
            steering = found.steering[policy]
            add_steering(writer, policy, recording.log_time, steering.action * found.largest, steering.omega, speed)
        add_sight(
            writer, recording.log_time, found.cones, found.count, found.observation, found.valid,
            frame=recording.frame, laser_yaw=laser_yaw, scale=scale,
        )  # fmt: skip
        for name, content in attached.items():
            writer.attach(name, "application/yaml", content)
        writer.describe("coil", {**about, "input_sha256": digest(recording.path)})


def foxglove_layout(found: OpenLoop, *, scan: str = SCAN, command: str | None = COMMAND) -> str:
    """The layout that comes with this package, for the policies, the frame and the topics of a replay.

    Args:
        found: of the replay.
        scan: topic of the LiDAR.
        command: topic of what the robot was told.
    """
    text = files("coil_rl.replay").joinpath("foxglove_layout.json").read_text(encoding="utf-8")
    layout: dict[str, Any] = json.loads(text)
    for name, panel in layout["configById"].items():
        if name.startswith("3D!"):
            # Foxglove knows frames without the leading slash that old drivers write.
            panel["followTf"] = found.recording.frame.removeprefix("/")
            panel["topics"] = {scan if topic == SCAN else topic: look for topic, look in panel["topics"].items()}
        elif name.startswith("Plot!"):
            panel["paths"] = [path for given in panel["paths"] for path in _paths(given, found, command)]
    return json.dumps(layout, indent=2) + "\n"


def _paths(given: Mapping[str, Any], found: OpenLoop, command: str | None) -> list[dict[str, Any]]:
    """What a line of the shipped layout becomes: one for each policy, or one of what was recorded, if anything was."""
    if POLICY in given["value"]:
        colours = style.strong_strokes(found.policies)
        return [
            {**given, "value": given["value"].replace(POLICY, policy), "label": policy, "color": colours[policy].colour}
            for policy in found.policies
        ]
    if command is None or RECORDED not in found.steering:
        return []
    return [{**given, "value": given["value"].replace(COMMAND, command)}]
