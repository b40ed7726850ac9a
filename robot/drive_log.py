"""The log of a live drive as MCAP, written while it drives.

It holds the scans and the commands on the topics of a recording, so `coil-replay` reads it, and
what the driver made of them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
from mcap.writer import CompressionType, Writer

from coil_rl.envs.recordings.mcap_files import CHUNK
from coil_rl.envs.recordings.messages import SCAN, TWIST, definition, encode, header, twist
from coil_robot.driver import Moment
from coil_robot.watchdog import Scan

TEXT, FLAG, NUMBER = "std_msgs/msg/String", "std_msgs/msg/Bool", "std_msgs/msg/Float64"


class DriveLog:
    """Writes each `Moment` of a drive, and completes the file at the end of a `with` block.

    Topics: `/scan`, `/cmd_vel`, `/coil/steering` (radians, of a scan that was driven by),
    `/coil/valid` (whether both boundaries were seen), and `/coil/state`, such as "driving" or
    "stopped: stamp that does not rise". Until it is complete the file has a name with a dot in
    front; it can be read as far as it goes. A disk that is full ends the log and not the drive.

    Args:
        path: of the file; its folder must exist.
        epoch: s, added to the steady clock for the log times.
        max_steering: degrees of an action of 1.
        about: entries of the metadata record `coil`.

    Attributes:
        problem: why it ended early; empty if it did not.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        epoch: float = 0.0,
        max_steering: float = 80.0,
        about: Mapping[str, str] | None = None,
    ) -> None:
        self.path, self.epoch, self.about = Path(path), epoch, dict(about or {})
        self.max_steering = math.radians(max_steering)
        self.unfinished = self.path.with_name(f".{self.path.stem}.{os.getpid()}{self.path.suffix}")
        self.problem = ""
        self._channels: dict[str, int] = {}

    def __enter__(self) -> Self:
        self._stream: BinaryIO = self.unfinished.open("wb")
        self._writer = Writer(self._stream, CHUNK, CompressionType.ZSTD, enable_data_crcs=True)
        self._writer.start(profile="ros2", library="coil-rl")
        self._writer.add_metadata("coil", self.about)
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        try:
            self._writer.finish()
            self._stream.close()
            self.unfinished.replace(self.path)
        except OSError as problem:
            self._end(problem)

    def __call__(self, moment: Moment) -> None:
        """Write a scan, the command that followed, and why the car stands, if it does."""
        if self.problem:
            return
        time = max(0, round((moment.now + self.epoch) * 1e9)) if math.isfinite(moment.now) else 0
        state = f"{moment.state}: {moment.reason}" if moment.reason else moment.state
        try:
            if moment.scan is not None:
                self._add("/scan", SCAN, time, _message_of(moment.scan))
            if moment.valid is not None:
                self._add("/coil/valid", FLAG, time, {"data": bool(moment.valid.all())})
            if math.isfinite(moment.action):
                angle = moment.action * self.max_steering
                self._add("/coil/steering", NUMBER, time, {"data": angle})
            self._add("/coil/state", TEXT, time, {"data": state})
            self._add("/cmd_vel", TWIST, time, twist(*moment.command))
        except OSError as problem:
            self._end(problem)

    def _end(self, problem: OSError) -> None:
        self.problem = f"{self.unfinished} cannot be written ({problem.strerror}); the log ends"

    def _add(self, topic: str, message_type: str, time: int, fields: Mapping[str, Any]) -> None:
        if topic not in self._channels:
            schema = self._writer.register_schema(message_type, "ros2msg", definition(message_type))
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        data = encode(message_type, fields)
        self._writer.add_message(self._channels[topic], time, data, time)


def _message_of(scan: Scan) -> dict[str, Any]:
    """Return the fields of a LaserScan."""
    angles = np.asarray(scan.angles, np.float64)
    first, last = (angles[0], angles[-1]) if angles.size else (0.0, 0.0)
    stamp = max(0, round(scan.stamp * 1e9)) if math.isfinite(scan.stamp) else 0
    return {
        "header": header(stamp, "laser"),
        "angle_min": first,
        "angle_max": last,
        "angle_increment": (last - first) / max(angles.size - 1, 1),
        "range_min": scan.range_min,
        "range_max": scan.range_max,
        "ranges": scan.ranges,
    }
