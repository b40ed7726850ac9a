"""Robot recordings as arrays: LiDAR scans, odometry and commands.

What a user of recordings needs is a few arrays with one clock. What robots record is messages of
several senders with two clocks each. This file chooses, checks and warns about what it leaves out.
"""

import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.envs.recordings.commands import command_topic, commands_of, spread
from coil_rl.envs.recordings.doubts import doubts_about
from coil_rl.envs.recordings.folders import RecordingError
from coil_rl.envs.recordings.mcap_files import Contents, read_messages
from coil_rl.envs.recordings.messages import COMMANDS, ODOMETRY, SCAN, pose_of, stamp_of
from coil_rl.envs.recordings.recording import Recording, ascending
from coil_rl.envs.recordings.scans import check_finite, decoded, scans_of


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

    A warning names what is left out (scans that are lost, odometry or commands of other types,
    other scanners), and what makes the meaning of the rest doubtful, see `Recording.remarks`.

    Args:
        path: of the file or folder.
        scan: topic of the LiDAR.
        odometry: topic of the odometry, or None; ignored if the recording does not have it.
        command: topic of the commands, Twist, AckermannDrive or their stamped types, or None; if
            the recording does not have it, the only other topic with commands is read.
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
        ...         scan = {"angle_increment": 0.0175, "range_max": 12.0, "ranges": np.ones(360)}
        ...         writer.add("/scan", SCAN, time, scan)
        >>> read_recording(path).ranges.shape
        (3, 360)
    """
    path = Path(path)
    types = _types_of_topics(path, scan, odometry, command)
    contents = read_messages(path, types, COMMANDS if command else ())
    remarks = [*_remarks_on_losses(contents, scan), *contents.remarks]
    for topic in types:
        remark = _ignore_other_types(path, topic, types[topic], contents, scan)
        if remark:
            remarks.append(remark)
    if not contents.messages[scan]:
        raise _no_scans(path, scan, contents)
    remarks += _put_in_order(path, contents, scan)
    if strict and (contents.cut_off or contents.damage):
        raise RecordingError(
            f"{path} {remarks[0]}; copy it again from where it was recorded, or set strict=false."
        )

    fields: dict[str, Any] = {"notes": contents.notes}
    if odometry:
        fields |= _odometry(path, odometry, contents, remarks)
    read = command_topic(command, contents, remarks) if command else None
    if read is not None:
        fields |= commands_of(path, read, contents, remarks)
    recording = Recording(path=path, **scans_of(path, scan, contents, frame, remarks), **fields)
    recording = spread(recording)
    remarks += doubts_about(recording)
    for remark in remarks:
        warnings.warn(f"{path} {remark}", stacklevel=2)
    return replace(recording, remarks=remarks)


def _put_in_order(path: Path, contents: Contents, scan: str) -> list[str]:
    """Sort messages by their log times, or say that the clock of the log was set back.

    Then the scans are in the order of their stamps, and what was logged later is taken as later.
    """
    back = -np.diff([message.log_time for message in contents.messages[scan]]).min(initial=0)
    stamps = decoded(path, scan, contents, lambda each, _: (stamp_of(each),))[1] if back else []
    if back and ascending(np.array(stamps)[:, 0]):
        for messages in contents.messages.values():
            step = np.diff([message.log_time for message in messages])
            usual = np.median(step) if len(step) else 0
            missing = np.cumsum(np.where(step < 0, usual - step, 0)).astype(np.int64)
            for number, more in enumerate(missing.tolist(), start=1):
                later = messages[number].log_time + more
                messages[number] = messages[number]._replace(log_time=later)
        return [f"has log times that step back by {back / 1e9:.3g} s, so stamps give the order"]
    for messages in contents.messages.values():
        messages.sort(key=lambda message: message.log_time)
    return []


def _odometry(path: Path, topic: str, contents: Contents, remarks: list[str]) -> dict[str, Any]:
    """Return the field of a `Recording` for its odometry, if it has any.

    Args:
        remarks: a remark is added if there is odometry on other topics only.
    """
    if not contents.messages[topic]:
        kinds = [channel.message_type for channel in contents.channels if channel.topic == topic]
        others = _topics(contents, (ODOMETRY,))
        if ODOMETRY in kinds:
            remarks.append(f"has no message on topic {topic}, so there is no odometry")
        elif others and not kinds:
            remarks.append(f"has no odometry on topic {topic}; choose with odometry={others}")
        return {}
    time, rows = decoded(path, topic, contents, lambda each, _: (stamp_of(each), pose_of(each)))
    poses = np.array([pose for _, pose in rows])
    check_finite(path, topic, time, poses, "the pose")
    return {"odometry": (poses, time, np.array([stamp for stamp, _ in rows]))}


def _types_of_topics(
    path: Path, scan: str, odometry: str | None, command: str | None
) -> dict[str, tuple[str, ...]]:
    """Return the message types that can be read on each topic; `path` is for a message."""
    types: dict[str, tuple[str, ...]] = {scan: (SCAN,)}
    if odometry:
        types[odometry] = (ODOMETRY,)
    if command:
        types[command] = COMMANDS
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


def _ignore_other_types(
    path: Path, topic: str, types: Sequence[str], contents: Contents, scan: str
) -> str | None:
    """Remove the messages of other types or encodings of a topic.

    Args:
        types: the message types that can be read.
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
    remedy = f"; give the topic of such messages, here {other_topics}" if other_topics else ""
    if topic == scan:
        remedy = remedy or f"; record the scans as {SCAN} with ROS 2"
        raise RecordingError(
            f"{path} has messages of {kind} in {encoding} on topic {topic}, not of {needed} in "
            f"cdr{remedy}."
        )
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
