"""Robot recordings as arrays: LiDAR scans, odometry and commands.

What a user of recordings needs is a few arrays with one clock. What robots record is messages of
several senders with two clocks each. This file chooses, checks and warns about what it leaves out.
"""

import math
import os
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.recordings.mcap_files import Contents, RecordingError, read_messages
from coil_rl.envs.recordings.messages import (
    ODOMETRY,
    SCAN,
    TWIST,
    TWIST_STAMPED,
    decode,
    pose_of,
    stamp_of,
    twist_of,
)

SIMULATED = "simulated"  # metadata record of simulated recordings
LARGEST = 1e7  # of poses, commands and angles
# All scans together may have this many ranges with their padding, and this many times their own.
LARGEST_PADDED, PADDED_SHARE = 10**7, 4

Floats = NDArray[np.float64]
Times = NDArray[np.int64]
# Frame, smallest and greatest range, name of the program that sent its scans.
Scanner = tuple[str, float, float, str]


@dataclass(frozen=True)
class Recording:
    """N scans of a LiDAR, with the odometry and the commands of the drive.

    Args:
        path: of the file or folder.
        log_time: [N] ns, when the scans were recorded, ascending.
        stamp: [N] ns, start of each scan by the scanner's clock.
        ranges: [N, P] m; infinite if not finite or outside the scanner's range, and for padding.
        points: [N], number of ranges of each scan.
        angle_min: [N] radians, bearing of the first range.
        angle_increment: [N] radians, step of the bearing, negative for clockwise rotation.
        odometry: poses [M, 3] (m, m, radians), with their log times and stamps [M] ns; None without
            odometry.
        commands: [M, 2] m/s and radians/s, with their log times [M] ns; None without commands.
        frame: of the scanner.
        stamped_commands: whether the commands are TwistStamped messages.
        notes: metadata records by name.
        remarks: what the file has and the arrays lack, such as "is cut off: 160 scans can be read".
    """

    path: Path
    log_time: Times
    stamp: Times
    ranges: NDArray[np.float32]
    points: NDArray[np.int64]
    angle_min: Floats
    angle_increment: Floats
    odometry: tuple[Floats, Times, Times] | None = None
    commands: tuple[Floats, Times] | None = None
    frame: str = "laser"
    stamped_commands: bool = False
    notes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    remarks: Sequence[str] = ()

    @property
    def simulated(self) -> bool:
        """Whether the metadata marks the recording as simulated."""
        return SIMULATED in self.notes

    @property
    def seconds(self) -> Floats:
        """[N] s since the first scan.

        They are taken by the scanner's clock, or by log time if that clock is not ascending.
        """
        clock = self.stamp if _ascending(self.stamp) else self.log_time
        return (clock - clock[0]) / 1e9

    def angles(self, scan: int | slice) -> Floats:
        """Return the bearings of a scan's ranges, [P] radians, or of several scans, [N, P]."""
        increment = self.angle_increment[scan][..., None]
        return np.asarray(
            self.angle_min[scan][..., None] + increment * np.arange(self.ranges.shape[1])
        )

    def poses(self) -> Floats:
        """Return the pose at the start of each scan, [N, 3] m, m, radians.

        Interpolated from the odometry; without odometry integrated from the commands; zeros without
        either.
        """
        if self.odometry is not None:
            pose, log_time, stamp = self.odometry
            stamped = _ascending(self.stamp) and _ascending(stamp)
            scan_time, pose_time = (self.stamp, stamp) if stamped else (self.log_time, log_time)
            # Relative times, as floating point would round absolute nanoseconds to a quarter of a
            # microsecond.
            at = (scan_time - pose_time[0]).astype(float)
            times = (pose_time - pose_time[0]).astype(float)
            columns = [pose[:, 0], pose[:, 1], np.unwrap(pose[:, 2])]
            return np.stack([np.interp(at, times, column) for column in columns], axis=1)
        if self.commands is not None:
            return _integrate_commands(*self.commands, self.log_time)
        return np.zeros((len(self.log_time), 3))

    def commands_of_scans(self, nominal_speed: float) -> Floats:
        """Return the command of each scan, [N, 2] m/s, radians/s; NaN before the first command.

        It is the last command before the next scan: a controller needs time for a scan, and a
        program that sends commands at a higher rate repeats the old one meanwhile. The speed is the
        command's own, with which its turn rate means a steering angle; if no command has one, that
        of the odometry, and without it the nominal one. A recording without commands is a
        `ValueError`.

        Args:
            nominal_speed: m/s.
        """
        if self.commands is None:
            raise ValueError(f"{self.path} has no commands; check that commands is not None")
        commands, times = self.commands
        last = np.searchsorted(times, np.append(self.log_time[1:], np.iinfo(np.int64).max)) - 1
        rows = np.where(last[:, None] < 0, np.nan, commands[last])
        if not commands[:, 0].any():
            rows[:, 0] = nominal_speed
            if self.odometry is not None:  # from each scan to the next one
                path = np.hypot(*np.diff(self.poses()[:, :2], axis=0).T)
                time = np.diff(self.seconds)
                speed = np.divide(path, time, out=np.zeros_like(path), where=time > 0)
                rows[:, 0] = np.append(speed, 0.0)
        return rows


def read_recording(
    path: str | os.PathLike[str],
    scan: str = "/scan",
    odometry: str | None = "/odom",
    command: str | None = "/cmd_vel",
    *,
    frame: str | None = None,
    strict: bool = False,
) -> Recording:
    """Read a recording with ROS 2 messages: an MCAP file or a rosbag2 folder.

    A warning names what is left out: scans that are lost, odometry or commands of other types,
    other scanners.

    Args:
        path: of the file or folder.
        scan: topic of the LiDAR.
        odometry: topic of the odometry, or None; ignored if the recording does not have it.
        command: topic of the commands, Twist or TwistStamped, or None; ignored if the recording
            does not have it.
        frame: of the scanner, if several send scans on one topic; None for the first one.
        strict: raise for a recording that is cut off or damaged, instead of a warning with the
            number of scans.

    Raises:
        RecordingError: for what cannot be read, in one sentence with its remedy.

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
    types = _types_of_topics(path, scan, odometry, command)
    contents = read_messages(path, types)
    remarks = _remarks_on_losses(contents, scan)
    for topic in types:
        remark = _ignore_other_types(path, topic, types[topic], contents, scan)
        if remark:
            remarks.append(remark)
    if not contents.messages[scan]:
        raise _no_scans(path, scan, contents)
    if strict and (contents.cut_off or contents.damage):
        raise RecordingError(
            f"{path} {remarks[0]}; copy it again from where it was recorded, or set strict=false."
        )

    extra: dict[str, Any] = {"notes": contents.notes, "remarks": remarks}
    if odometry and contents.messages[odometry]:
        time, rows = _decoded(
            path, odometry, contents, lambda each: (stamp_of(each), pose_of(each))
        )
        poses = np.array([pose for _, pose in rows])
        _check_finite(path, odometry, time, poses, "the pose")
        extra["odometry"] = poses, time, np.array([stamp for stamp, _ in rows])
    if command and contents.messages[command]:
        time, twists = _decoded(path, command, contents, twist_of)
        _check_finite(path, command, time, np.array(twists), "the command")
        extra["commands"] = np.array(twists), time
        message_type = contents.messages[command][0].channel.message_type
        extra["stamped_commands"] = message_type == TWIST_STAMPED
    fields = _scans(path, scan, contents, frame, remarks)
    for remark in remarks:
        warnings.warn(f"{path} {remark}", stacklevel=2)
    return Recording(path=path, **fields, **extra)


def _types_of_topics(
    path: Path, scan: str, odometry: str | None, command: str | None
) -> dict[str, tuple[str, ...]]:
    """Return the message types that can be read on each topic; `path` is for a message."""
    types: dict[str, tuple[str, ...]] = {scan: (SCAN,)}
    if odometry:
        types[odometry] = (ODOMETRY,)
    if command:
        types[command] = (TWIST, TWIST_STAMPED)
    if len(types) < 1 + bool(odometry) + bool(command):
        raise RecordingError(
            f"{path}: scan={scan}, odometry={odometry}, command={command} must be different topics."
        )
    return types


def _remarks_on_losses(contents: Contents, scan: str) -> list[str]:
    """Return remarks on scans that an early end or damage of a file made unreadable."""
    scans, lost = len(contents.messages[scan]), contents.lost.get(scan, "an unknown number")
    remarks = []
    if contents.cut_off:
        remarks.append(f"is cut off: {scans} scans can be read")
    if contents.damage:
        remarks.append(
            f"is damaged at {contents.damage[0]}: {scans} scans can be read, {lost} are lost"
        )
    return remarks


def _scans(
    path: Path, topic: str, contents: Contents, frame: str | None, remarks: list[str]
) -> dict[str, Any]:
    """Return the fields of a `Recording` that come from the scans.

    Args:
        path: of the recording, for messages.
        topic: of the scans.
        contents: of the recording.
        frame: of the scanner; None for the first one.
        remarks: a remark is added if other scanners are left out.
    """

    def fields(message: Any) -> tuple[Any, ...]:
        scanner = message.header.frame_id, message.range_min, message.range_max
        if math.isnan(message.range_min + message.range_max):
            raise ValueError("its smallest or greatest range is not a number")
        ranges = np.asarray(message.ranges, np.float32)
        return stamp_of(message), scanner, (message.angle_min, message.angle_increment), ranges

    log_time, messages = _decoded(path, topic, contents, fields)
    angles = np.array([row[2] for row in messages])
    _check_finite(path, topic, log_time, angles, "the angle of its first range, or between ranges,")
    # Recordings that were converted from ROS 1 name the program that sent a message.
    senders = (
        dict(message.channel.metadata).get("callerid", "") for message in contents.messages[topic]
    )
    scanners = [(*row[1], sender) for row, sender in zip(messages, senders, strict=True)]
    chosen = _choose_scanner(path, topic, scanners, frame, remarks)
    kept = [row for row, scanner in enumerate(scanners) if scanner == chosen]
    stamps, _, _, scans = zip(*(messages[row] for row in kept), strict=True)
    points = np.array([len(scan) for scan in scans])
    if not points.any():
        raise RecordingError(
            f"{path}, topic {topic}: no scan has a range; check that the scanner ran, and record "
            "again."
        )
    # All scans get the length of the longest, so one long scan makes all of them long.
    if len(scans) * points.max() > max(LARGEST_PADDED, PADDED_SHARE * points.sum()):
        raise RecordingError(
            f"{path}, topic {topic}: scans of {points.min()} to {points.max()} ranges; a scanner "
            "has about as many in each: record those of one scanner."
        )
    ranges = np.full((len(scans), points.max()), np.inf, np.float32)
    for row, scan in zip(ranges, scans, strict=True):
        row[: len(scan)] = scan
    range_min, range_max = np.float32(chosen[1]), np.float32(chosen[2])
    ranges[~((ranges >= range_min) & (ranges <= range_max))] = np.inf
    return {
        "log_time": log_time[kept],
        "stamp": np.array(stamps),
        "ranges": ranges,
        "points": points,
        "angle_min": angles[kept, 0],
        "angle_increment": angles[kept, 1],
        "frame": chosen[0],
    }


def _choose_scanner(
    path: Path, topic: str, scanners: Sequence[Scanner], frame: str | None, remarks: list[str]
) -> Scanner:
    """Return the first scanner, or the first one with a frame.

    Args:
        path: of the recording, for messages.
        topic: of the scans.
        scanners: of all scans.
        frame: to choose; None for the first scanner.
        remarks: a remark is added if there are others to choose from.
    """
    scans = Counter(scanners)
    candidates = [scanner for scanner in scans if frame in (None, scanner[0])]
    if not candidates:
        frames = " or ".join(dict.fromkeys(scanner[0] for scanner in scans))
        raise RecordingError(
            f"{path}, topic {topic} has no scan with the frame {frame}; give frame={frames}."
        )
    if len(candidates) > 1:
        names = ", ".join(_described(scanner, scans[scanner]) for scanner in candidates)
        same = len({scanner[0] for scanner in candidates}) < len(candidates)
        remedy = "record each on a topic of its own" if same else "choose with frame=NAME"
        remarks.append(
            f"has several scanners on topic {topic}, of which the first is read: {names}; {remedy}"
        )
    return candidates[0]


def _described(scanner: Scanner, scans: int) -> str:
    """Return a scanner with its number of scans, for a remark."""
    frame, _, range_max, sender = scanner
    name = " of ".join(filter(None, (frame, sender))) or "no frame"
    return f"{name} ({scans} scans to {range_max:g} m)"


def _integrate_commands(commands: Floats, command_time: Times, time: Times) -> Floats:
    """Return the poses of a robot that holds each command until the next one.

    It stands before the first one.

    Args:
        commands: [M, 2] m/s and radians/s.
        command_time: [M] ns.
        time: [N] ns, times of the poses.

    Returns:
        Poses [N, 3], m, m and radians.
    """
    moments = np.union1d(command_time, time)
    index = np.searchsorted(command_time, moments, side="right") - 1
    speed, turn_rate = np.where(index[:, None] < 0, 0.0, commands[index]).T
    step = np.diff(moments, append=moments[-1:]) / 1e9
    heading = np.cumsum(turn_rate * step) - turn_rate * step
    # The chord of an arc has the direction of the arc's middle.
    direction = heading + turn_rate * step / 2
    chord = speed * step * np.sinc(turn_rate * step / (2 * np.pi))
    east, north = chord * np.cos(direction), chord * np.sin(direction)
    x, y = np.cumsum(east) - east, np.cumsum(north) - north
    return np.stack([x, y, heading], axis=1)[np.searchsorted(moments, time)]


def _ascending(times: Times) -> bool:
    """Return whether each time is later than the one before."""
    return bool((np.diff(times) > 0).all())


def _decoded(
    path: Path, topic: str, contents: Contents, fields: Callable[[Any], tuple[Any, ...]]
) -> tuple[Times, list[tuple[Any, ...]]]:
    """Return the log times of a topic, and the chosen fields of its messages.

    Args:
        path: of the recording, for messages.
        topic: of the messages.
        contents: of the recording.
        fields: takes a decoded message and returns what is needed of it.
    """
    rows = []
    for index, (channel, log_time, _, data) in enumerate(contents.messages[topic]):
        try:
            message = decode(data, channel.message_type, channel.language, channel.definition)
            rows.append(fields(message))
        except Exception as error:  # bytes and definition may be anything
            raise RecordingError(
                f"{path}, topic {topic}, message {index} at {log_time / 1e9:.3f} s: it is not a "
                f"valid {channel.message_type} ({' '.join(str(error).split())}); record it again, "
                "or correct the program that sent it."
            ) from None
    return np.array([message.log_time for message in contents.messages[topic]]), rows


def _ignore_other_types(
    path: Path, topic: str, types: Sequence[str], contents: Contents, scan: str
) -> str | None:
    """Remove the messages of other types or encodings of a topic.

    Args:
        path: of the recording, for messages.
        topic: of the messages.
        types: the message types that can be read.
        contents: of the recording.
        scan: topic of the scans; if there are only other messages on it, a `RecordingError` is
            raised.

    Returns:
        A remark on the removed messages; None if there are none.
    """
    channels = [channel for channel in contents.channels if channel.topic == topic]
    others = [each for each in channels if each.message_type not in types or each.encoding != "cdr"]
    if not others:
        return None
    contents.messages[topic] = [
        message for message in contents.messages[topic] if message.channel not in others
    ]
    kind = others[0].message_type or "no type"
    encoding = others[0].encoding or "no encoding"
    needed = " or ".join(types)
    if len(others) < len(channels):
        return (
            f"has messages of {kind} in {encoding} on topic {topic}, not of {needed} in cdr, and "
            "they are ignored"
        )
    other_topics = _topics(contents, types)
    if topic == scan and not other_topics:
        raise RecordingError(
            f"{path} has messages of {kind} in {encoding} on topic {topic}, not of {needed} in "
            f"cdr; record the scans as {SCAN} with ROS 2."
        )
    if topic == scan:
        raise RecordingError(
            f"{path} has messages of {kind} in {encoding} on topic {topic}, not of {needed} in "
            f"cdr; give the topic of such messages, here {other_topics}."
        )
    remedy = f"; give the topic of such messages, here {other_topics}" if other_topics else ""
    return (
        f"has messages of {kind} in {encoding} on topic {topic}, not of {needed} in cdr, and they "
        f"are ignored{remedy}"
    )


def _no_scans(path: Path, topic: str, contents: Contents) -> RecordingError:
    """Return the error for a recording without scans, which says what there is instead."""
    if contents.cut_off or contents.damage:
        loss = "cut off" if contents.cut_off else "damaged"
        return RecordingError(
            f"{path} is {loss} before its first scan; copy it again from where it was recorded."
        )
    if any(channel.topic == topic for channel in contents.channels):
        return RecordingError(
            f"{path}, topic {topic} has no message; check that the scanner ran, and record it "
            "again."
        )
    others = _topics(contents, (SCAN,))
    if others:
        return RecordingError(
            f"{path} has no topic {topic}; give the topic of the LiDAR, here {others}."
        )
    topics = ", ".join(sorted({channel.topic for channel in contents.channels})) or "none"
    return RecordingError(
        f"{path} has no scans of a LiDAR ({SCAN} in cdr), its topics are: {topics}; record one too."
    )


def _topics(contents: Contents, types: Sequence[str]) -> str:
    """Return the topics with messages of some types that can be decoded, for a message."""
    channels = [channel for channel in contents.channels if channel.encoding == "cdr"]
    topics = {channel.topic for channel in channels if channel.message_type in types}
    return " or ".join(sorted(topics))


def _check_finite(path: Path, topic: str, time: Times, values: Floats, name: str) -> None:
    """Raise a `RecordingError` for a message with numbers beyond what any robot does.

    Args:
        path: of the recording, for the message.
        topic: of the values.
        time: [M] ns, log time of each message.
        values: [M, n], in m, radians and s.
        name: of the values, for the message.
    """
    wrong = np.flatnonzero(~(np.abs(values) < LARGEST).all(axis=1))
    if len(wrong):
        index = int(wrong[0])
        raise RecordingError(
            f"{path}, topic {topic}, message {index} at {time[index] / 1e9:.3f} s: {name} is not a "
            f"number below {LARGEST:g}; record it again, or correct the program that sent it."
        )
