"""A robot's recording as arrays: turns of its LiDAR, where it was, and how it was told to move."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Schema
from numpy.typing import NDArray

from coil_rl.envs.recordings.mcap_files import Contents, RecordingError, Source, read_messages
from coil_rl.envs.recordings.ros_messages import LaserScan, decoder, from_fields

SIMULATED = "simulated"  # the metadata record that says so
SCAN, ODOMETRY, TWIST = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist"

Floats = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True)
class Recording:
    """N turns of a LiDAR, and what else is known about the drive.

    Attributes:
        path: where it was read from.
        cut_off: whether the file ends too early.
        log_time: [N] ns, when each turn was recorded, in order.
        stamp: [N] ns, when each turn began, by the scanner's clock.
        ranges: [N, P] m, float32; inf where nothing came back: what is no number or outside of the scanner's range, and
            beyond the points that a turn has.
        points: [N], how many ranges each turn has.
        angle_min: [N] radians, of the first range.
        angle_increment: [N] radians from one range to the next, negative for a scanner that turns clockwise.
        odometry: where the robot was: [M, 3] m, m, radians, and at which log time and stamp [M] ns; None if unknown.
        commands: how it was told to move: [M, 2] m/s, radians/s, and at which log time [M] ns; None if unknown.
        frame: in which the scanner measures.
        notes: its metadata records, by name.
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
        """Whether the recording says that it is."""
        return SIMULATED in self.notes

    @property
    def seconds(self) -> Floats:
        """[N] s since the first turn: by the scanner's clock unless that one ever runs backwards."""
        clock = self.stamp if _runs_forwards(self.stamp) else self.log_time
        return (clock - clock[0]) / 1e9

    def angles(self, turn: int) -> Floats:
        """[P] radians, the bearings of a turn's ranges."""
        return self.angle_min[turn] + self.angle_increment[turn] * np.arange(self.ranges.shape[1])

    def poses(self) -> Floats:
        """[N, 3] m, m, radians: where the robot was when each turn began.

        From the odometry, in between along straight lines; else from the commands, each obeyed until the next; else all
        zeros, for then nothing says that it moved.
        """
        if self.odometry is not None:
            pose, log_time, stamp = self.odometry
            stamped = _runs_forwards(self.stamp) and _runs_forwards(stamp)
            when, known = (self.stamp, stamp) if stamped else (self.log_time, log_time)
            # In floating point the nanoseconds of our days would only be known to a quarter of a microsecond.
            at, times = (when - known[0]).astype(float), (known - known[0]).astype(float)
            columns = [pose[:, 0], pose[:, 1], np.unwrap(pose[:, 2])]
            return np.stack([np.interp(at, times, column) for column in columns], axis=1)
        if self.commands is not None:
            return _obeyed(*self.commands, self.log_time)
        return np.zeros((len(self.log_time), 3))


def read_recording(
    path: str | os.PathLike[str],
    scan: str = "/scan",
    odometry: str | None = "/odom",
    command: str | None = "/cmd_vel",
    *,
    strict: bool = False,
) -> Recording:
    """Read a recording, an MCAP file or a rosbag2 directory, with ROS 2 messages in CDR.

    Args:
        path: where it is.
        scan: topic of the LiDAR.
        odometry: topic of the odometry; None leaves it out, and one that the recording does not have is left out.
        command: topic of the commands, likewise.
        strict: refuse a recording that was cut off, instead of a warning that says how many scans it has.

    Raises:
        RecordingError: in one sentence, what is wrong with the recording and what to do.

    Example:
        >>> import tempfile
        >>> from coil_rl.envs.recordings.writer import RecordingWriter
        >>> path = Path(tempfile.mkdtemp()) / "drive.mcap"
        >>> with RecordingWriter(path) as drive:
        ...     for turn in range(3):
        ...         scan = LaserScan(turn * 10**8, -3.14, 0.0175, 0.15, 12.0, np.ones(360))
        ...         drive.add("/scan", SCAN, time=scan.stamp, data=scan.to_bytes())
        >>> read_recording(path).ranges.shape
        (3, 360)
    """
    path = Path(path)
    wanted = [(scan, SCAN), *((topic, kind) for topic, kind in ((odometry, ODOMETRY), (command, TWIST)) if topic)]
    kinds = dict(wanted)
    if len(kinds) < len(wanted):
        raise RecordingError(f"{path}: scan={scan}, odometry={odometry}, command={command} must be different topics.")
    contents = read_messages(path, kinds)
    for topic, kind in kinds.items():
        _check_sources(path, topic, kind, contents)
    if not contents.messages[scan]:
        raise _without_scans(path, scan, contents)
    if contents.cut_off:
        found = f"{path} is cut off: {len(contents.messages[scan])} scans can be read"
        if strict:
            raise RecordingError(
                f"{found}; copy it anew from where it was recorded, or replay these with strict=false."
            )
        warnings.warn(found, stacklevel=2)

    time, turns = _decoded(path, scan, contents)
    recording = _scans(path, scan, contents.cut_off, time, turns)
    extra: dict[str, Any] = {"notes": contents.notes}
    if odometry and contents.messages[odometry]:
        time, places = _decoded(path, odometry, contents)
        pose = np.array([(place.x, place.y, place.heading) for place in places])
        _check_finite(path, odometry, time, pose, "the pose")
        extra["odometry"] = pose, time, np.array([place.stamp for place in places])
    if command and contents.messages[command]:
        time, twists = _decoded(path, command, contents)
        _check_finite(path, command, time, np.array(twists), "the command")
        extra["commands"] = np.array(twists), time
    return Recording(**recording, **extra)


def _scans(path: Path, topic: str, cut_off: bool, log_time: Times, turns: Sequence[LaserScan]) -> dict[str, Any]:
    points = np.array([len(turn.ranges) for turn in turns])
    limits = np.array([turn[1:5] for turn in turns])  # angle_min, angle_increment, range_min, range_max
    _check_finite(path, topic, log_time, limits[:, :2], "the angle of its first range, or from one to the next,")
    if not points.any():
        raise RecordingError(
            f"{path}, topic {topic}: no scan has a range; check that the scanner ran, and record it anew."
        )
    if points.min() == points.max():
        ranges = np.stack([turn.ranges for turn in turns])
    else:
        ranges = np.full((len(turns), points.max()), np.inf, np.float32)
        for row, turn in zip(ranges, turns, strict=True):
            row[: len(turn.ranges)] = turn.ranges
    nearest, farthest = limits[:, 2:3].astype(np.float32), limits[:, 3:4].astype(np.float32)
    ranges[~((ranges >= nearest) & (ranges <= farthest))] = np.inf
    return {
        "path": path, "cut_off": cut_off, "log_time": log_time, "stamp": np.array([turn.stamp for turn in turns]),
        "ranges": ranges, "points": points, "angle_min": limits[:, 0], "angle_increment": limits[:, 1],
        "frame": turns[0].frame,
    }  # fmt: skip


def _obeyed(commands: Floats, since: Times, when: Times) -> Floats:
    """Poses at the times `when` of a robot that does what it was told last; before the first command it stands."""
    # Every moment at which a command begins or a pose is asked for, and which command holds from there on.
    moments = np.union1d(since, when)
    holds = np.searchsorted(since, moments, side="right") - 1
    speed, turn_rate = np.where(holds[:, None] < 0, 0.0, commands[holds]).T
    step = np.diff(moments, append=moments[-1:]) / 1e9
    heading = _sum_before(turn_rate * step)
    # Along an arc the way goes in the direction of its middle.
    middle = heading + turn_rate * step / 2
    way = speed * step * np.sinc(turn_rate * step / (2 * np.pi))
    x, y = _sum_before(way * np.cos(middle)), _sum_before(way * np.sin(middle))
    return np.stack([x, y, heading], axis=1)[np.searchsorted(moments, when)]


def _sum_before(steps: Floats) -> Floats:
    return np.cumsum(steps) - steps


def _runs_forwards(times: Times) -> bool:
    return bool((np.diff(times) > 0).all())


def _decoded(path: Path, topic: str, contents: Contents) -> tuple[Times, list[Any]]:
    """The log times and the messages of a topic."""
    stored = contents.messages[topic]
    decode = decoder(stored[0].source.kind)
    messages = []
    for index, (source, log_time, _, data) in enumerate(stored):
        try:
            messages.append(decode(data))
        except ValueError as error:
            remedy = "record it anew, or mend the program that sent it"
            try:
                messages.append(from_fields(source.kind, _by_definition(source)(data)))
                continue
            except ImportError:
                remedy += "; if its layout is another one, python -m pip install 'coil-rl[ros]' reads that too"
            # The bytes and the definition may be anything, and so is what the library makes of them.
            except Exception:
                pass
            raise _error(path, topic, index, log_time, str(error), remedy) from None
    return np.array([message.log_time for message in stored]), messages


@lru_cache(maxsize=8)
def _by_definition(source: Source) -> Callable[[bytes], Any]:
    """Reads messages of another layout, such as another byte order, slowly by the definition stored with them."""
    from mcap_ros2.decoder import DecoderFactory

    schema = Schema(id=1, name=source.kind, encoding=source.language, data=source.definition)
    decode = DecoderFactory().decoder_for(source.encoding, schema)
    if decode is None:
        raise ValueError(f"there is no decoder for definitions in {source.language or 'no language'}")
    return decode


def _check_sources(path: Path, topic: str, kind: str, contents: Contents) -> None:
    """Refuse a topic with other messages than those of a type in CDR."""
    for source in contents.sources:
        if source.topic == topic and (source.kind != kind or source.encoding != "cdr"):
            found = f"{source.kind or 'no type'} in {source.encoding or 'no encoding'}"
            others = _topics(contents, kind)
            remedy = f"give the topic of such messages, here {others}" if others else "record it with ROS 2"
            raise RecordingError(f"{path}, topic {topic} has messages of {found}, not of {kind} in cdr; {remedy}.")


def _without_scans(path: Path, topic: str, contents: Contents) -> RecordingError:
    if contents.cut_off:
        return RecordingError(f"{path} is cut off before its first scan; copy it anew from where it was recorded.")
    if any(source.topic == topic for source in contents.sources):
        return RecordingError(f"{path}, topic {topic} has no message; check that the scanner ran, and record it anew.")
    others = _topics(contents, SCAN)
    if others:
        return RecordingError(f"{path} has no topic {topic}; give the topic of the LiDAR, here {others}.")
    found = ", ".join(sorted({source.topic for source in contents.sources})) or "none"
    return RecordingError(f"{path} has no scans of a LiDAR ({SCAN} in cdr), its topics are: {found}; record one too.")


def _topics(contents: Contents, kind: str) -> str:
    fitting = {source.topic for source in contents.sources if source.kind == kind and source.encoding == "cdr"}
    return " or ".join(sorted(fitting))


def _check_finite(path: Path, topic: str, time: Times, values: Floats, name: str) -> None:
    """Refuse numbers [M, n] of which one is not finite."""
    wrong = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(wrong):
        index = int(wrong[0])
        remedy = "record it anew, or mend the program that sent it"
        raise _error(path, topic, index, time[index], f"{name} is not a finite number", remedy)


def _error(path: Path, topic: str, index: int, time: int, what: str, remedy: str) -> RecordingError:
    return RecordingError(f"{path}, topic {topic}, message {index} at {time / 1e9:.3f} s: {what}; {remedy}.")
