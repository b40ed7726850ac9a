"""Robot recordings as arrays: LiDAR scans, odometry and commands."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.recordings.mcap_files import Contents, RecordingError, read_messages
from coil_rl.envs.recordings.messages import ODOMETRY, SCAN, TWIST, decode, pose_of, stamp_of

SIMULATED = "simulated"  # metadata record of simulated recordings
REMEDY = "record it again, or correct the program that sent it"

Floats = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True)
class Recording:
    """N scans of a LiDAR, with the odometry and the commands of the drive.

    Attributes:
        path: of the file or folder.
        cut_off: whether the file ends early.
        log_time: [N] ns, ascending.
        stamp: [N] ns, start of each scan by the scanner's clock.
        ranges: [N, P] m, float32; inf for values that are not finite or outside the scanner's range, and for padding.
        points: [N] number of ranges of each scan.
        angle_min, angle_increment: [N] radians, bearing of the first range, and step, negative for clockwise rotation.
        odometry: poses [M, 3] m, m, radians, with their log times and stamps [M] ns; None without odometry.
        commands: [M, 2] m/s, radians/s, with their log times [M] ns; None without commands.
        frame: of the scanner.
        notes: metadata records by name.
    """

    path: Path
    cut_off: bool
    log_time: Times
    stamp: Times
    ranges: NDArray[np.float32]
    points: NDArray[np.int64]
    angle_min: Floats
    angle_increment: Floats
    odometry: tuple[Floats, Times, Times] | None = None
    commands: tuple[Floats, Times] | None = None
    frame: str = "laser"
    notes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def simulated(self) -> bool:
        """Whether the metadata marks the recording as simulated."""
        return SIMULATED in self.notes

    @property
    def seconds(self) -> Floats:
        """[N] s since the first scan, by the scanner's clock, or by log time if that clock is not ascending."""
        clock = self.stamp if _ascending(self.stamp) else self.log_time
        return (clock - clock[0]) / 1e9

    def angles(self, scan: int) -> Floats:
        """Return the bearings of a scan's ranges, [P] radians."""
        return self.angle_min[scan] + self.angle_increment[scan] * np.arange(self.ranges.shape[1])

    def poses(self) -> Floats:
        """Return the pose at the start of each scan, [N, 3] m, m, radians.

        Interpolated from the odometry; without odometry integrated from the commands; zeros without either.
        """
        if self.odometry is not None:
            pose, log_time, stamp = self.odometry
            stamped = _ascending(self.stamp) and _ascending(stamp)
            scan_time, pose_time = (self.stamp, stamp) if stamped else (self.log_time, log_time)
            # Relative times, as floating point would round absolute nanoseconds to a quarter of a microsecond.
            at, times = (scan_time - pose_time[0]).astype(float), (pose_time - pose_time[0]).astype(float)
            columns = [pose[:, 0], pose[:, 1], np.unwrap(pose[:, 2])]
            return np.stack([np.interp(at, times, column) for column in columns], axis=1)
        if self.commands is not None:
            return _integrate_commands(*self.commands, self.log_time)
        return np.zeros((len(self.log_time), 3))

    def commands_of_scans(self, nominal_speed: float) -> Floats:
        """Return the command of each scan, [N, 2] m/s, radians/s; NaN before the first command.

        It is the last command before the next scan: a controller needs time for a scan, and a program that sends
        commands at a higher rate repeats the old one meanwhile. The speed is the command's own, with which its turn
        rate means a steering angle; if no command has one, that of the odometry, and without it the nominal one, m/s.

        Raises:
            ValueError: if the recording has no commands.
        """
        if self.commands is None:
            raise ValueError(f"{self.path} has no commands; check that commands is not None")
        commands, times = self.commands
        last = np.searchsorted(times, np.append(self.log_time[1:], np.iinfo(np.int64).max)) - 1
        rows = np.where(last[:, None] < 0, np.nan, commands[last])
        if not commands[:, 0].any():
            rows[:, 0] = nominal_speed if self.odometry is None else self._measured_speeds()
        return rows

    def _measured_speeds(self) -> Floats:
        """Return the speed from each scan to the next one by odometry, [N] m/s."""
        poses, seconds = self.poses(), self.seconds
        path, time = np.hypot(*np.diff(poses[:, :2], axis=0).T), np.diff(seconds)
        return np.append(np.divide(path, time, out=np.zeros_like(path), where=time > 0), 0.0)


def read_recording(
    path: str | os.PathLike[str],
    scan: str = "/scan",
    odometry: str | None = "/odom",
    command: str | None = "/cmd_vel",
    *,
    strict: bool = False,
) -> Recording:
    """Read a recording with ROS 2 messages: an MCAP file or a rosbag2 folder.

    Args:
        path: of the file or folder.
        scan: topic of the LiDAR.
        odometry: its topic, or None; ignored if the recording does not have it.
        command: likewise, for the commands.
        strict: raise for a recording that is cut off, instead of a warning with the number of scans.

    Raises:
        RecordingError: in one sentence, the problem and its remedy.

    Example:
        >>> import tempfile
        >>> from coil_rl.envs.recordings.mcap_files import RecordingWriter
        >>> path = Path(tempfile.mkdtemp()) / "drive.mcap"
        >>> with RecordingWriter(path) as writer:
        ...     for time in (0, 10**8, 2 * 10**8):
        ...         writer.add("/scan", SCAN, time, {"range_max": 12.0, "ranges": np.ones(360)})
        >>> read_recording(path).ranges.shape
        (3, 360)
    """
    path = Path(path)
    topics = [(scan, SCAN), *((topic, kind) for topic, kind in ((odometry, ODOMETRY), (command, TWIST)) if topic)]
    if len(dict(topics)) < len(topics):
        raise RecordingError(f"{path}: scan={scan}, odometry={odometry}, command={command} must be different topics.")
    contents = read_messages(path, dict(topics))
    for topic, message_type in topics:
        _check_channels(path, topic, message_type, contents)
    if not contents.messages[scan]:
        raise _no_scans(path, scan, contents)
    if contents.cut_off:
        problem = f"{path} is cut off: {len(contents.messages[scan])} scans can be read"
        if strict:
            raise RecordingError(f"{problem}; copy it again from where it was recorded, or set strict=false.")
        warnings.warn(problem, stacklevel=2)

    extra: dict[str, Any] = {"notes": contents.notes}
    if odometry and contents.messages[odometry]:
        time, rows = _decoded(path, odometry, contents, lambda message: (stamp_of(message), pose_of(message)))
        poses = np.array([pose for _, pose in rows])
        _check_finite(path, odometry, time, poses, "the pose")
        extra["odometry"] = poses, time, np.array([stamp for stamp, _ in rows])
    if command and contents.messages[command]:
        time, twists = _decoded(path, command, contents, lambda message: (message.linear.x, message.angular.z))
        _check_finite(path, command, time, np.array(twists), "the command")
        extra["commands"] = np.array(twists), time
    return Recording(path=path, cut_off=contents.cut_off, **_scans(path, scan, contents), **extra)


def _scans(path: Path, topic: str, contents: Contents) -> dict[str, Any]:
    """Return the fields of a `Recording` that come from the scans."""

    def fields(message: Any) -> tuple[Any, ...]:
        limits = (message.angle_min, message.angle_increment, message.range_min, message.range_max)
        return stamp_of(message), message.header.frame_id, limits, np.asarray(message.ranges, np.float32)

    log_time, messages = _decoded(path, topic, contents, fields)
    stamps, frames, limits_of_scans, scans = zip(*messages, strict=True)
    limits, points = np.array(limits_of_scans), np.array([len(scan) for scan in scans])
    _check_finite(path, topic, log_time, limits[:, :2], "the angle of its first range, or between ranges,")
    if not points.any():
        raise RecordingError(
            f"{path}, topic {topic}: no scan has a range; check that the scanner ran, and record again."
        )
    ranges = np.full((len(scans), points.max()), np.inf, np.float32)
    for row, scan in zip(ranges, scans, strict=True):
        row[: len(scan)] = scan
    range_min, range_max = limits[:, 2:3].astype(np.float32), limits[:, 3:4].astype(np.float32)
    ranges[~((ranges >= range_min) & (ranges <= range_max))] = np.inf
    return {
        "log_time": log_time, "stamp": np.array(stamps), "ranges": ranges, "points": points,
        "angle_min": limits[:, 0], "angle_increment": limits[:, 1], "frame": frames[0],
    }  # fmt: skip


def _integrate_commands(commands: Floats, command_time: Times, time: Times) -> Floats:
    """Return the poses at `time` if each command holds until the next one; the robot stands before the first."""
    moments = np.union1d(command_time, time)
    index = np.searchsorted(command_time, moments, side="right") - 1
    speed, turn_rate = np.where(index[:, None] < 0, 0.0, commands[index]).T
    step = np.diff(moments, append=moments[-1:]) / 1e9
    heading = np.cumsum(turn_rate * step) - turn_rate * step
    # The chord of an arc has the direction of the arc's middle.
    direction = heading + turn_rate * step / 2
    chord = speed * step * np.sinc(turn_rate * step / (2 * np.pi))
    x, y = (np.cumsum(part) - part for part in (chord * np.cos(direction), chord * np.sin(direction)))
    return np.stack([x, y, heading], axis=1)[np.searchsorted(moments, time)]


def _ascending(times: Times) -> bool:
    return bool((np.diff(times) > 0).all())


def _decoded(
    path: Path, topic: str, contents: Contents, fields: Callable[[Any], tuple[Any, ...]]
) -> tuple[Times, list[tuple[Any, ...]]]:
    """Return the log times of a topic, and the chosen fields of its messages."""
    rows = []
    for index, (channel, log_time, _, data) in enumerate(contents.messages[topic]):
        try:
            rows.append(fields(decode(data, channel.message_type, channel.language, channel.definition)))
        except Exception as error:  # bytes and definition may be anything
            problem = f"it is not a valid {channel.message_type} ({' '.join(str(error).split())})"
            raise _message_error(path, topic, index, log_time, problem) from None
    return np.array([message.log_time for message in contents.messages[topic]]), rows


def _check_channels(path: Path, topic: str, message_type: str, contents: Contents) -> None:
    """Raise if a topic has messages of another type or encoding."""
    for channel in contents.channels:
        if channel.topic == topic and (channel.message_type != message_type or channel.encoding != "cdr"):
            given = f"{channel.message_type or 'no type'} in {channel.encoding or 'no encoding'}"
            others = _topics(contents, message_type)
            remedy = f"give the topic of such messages, here {others}" if others else "record it with ROS 2"
            raise RecordingError(
                f"{path}, topic {topic} has messages of {given}, not of {message_type} in cdr; {remedy}."
            )


def _no_scans(path: Path, topic: str, contents: Contents) -> RecordingError:
    if contents.cut_off:
        return RecordingError(f"{path} is cut off before its first scan; copy it again from where it was recorded.")
    if any(channel.topic == topic for channel in contents.channels):
        return RecordingError(f"{path}, topic {topic} has no message; check that the scanner ran, and record it again.")
    if others := _topics(contents, SCAN):
        return RecordingError(f"{path} has no topic {topic}; give the topic of the LiDAR, here {others}.")
    topics = ", ".join(sorted({channel.topic for channel in contents.channels})) or "none"
    return RecordingError(f"{path} has no scans of a LiDAR ({SCAN} in cdr), its topics are: {topics}; record one too.")


def _topics(contents: Contents, message_type: str) -> str:
    channels = (channel for channel in contents.channels if channel.encoding == "cdr")
    return " or ".join(sorted({channel.topic for channel in channels if channel.message_type == message_type}))


def _check_finite(path: Path, topic: str, time: Times, values: Floats, name: str) -> None:
    """Raise if a row of values [M, n] is not finite."""
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(wrong):
        index = int(wrong[0])
        raise _message_error(path, topic, index, time[index], f"{name} is not a finite number")


def _message_error(path: Path, topic: str, index: int, time: int, problem: str) -> RecordingError:
    return RecordingError(f"{path}, topic {topic}, message {index} at {time / 1e9:.3f} s: {problem}; {REMEDY}.")
