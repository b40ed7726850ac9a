"""The scans of a recording as one array: choice of the scanner, bearings and ranges."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.recordings.bearings import Angles, bearings
from coil_rl.envs.recordings.folders import CONVERT, RecordingError
from coil_rl.envs.recordings.mcap_files import Contents
from coil_rl.envs.recordings.messages import decode, stamp_of
from coil_rl.envs.recordings.recording import Times

LARGEST = 1e7  # of poses, commands and angles
# All scans together may have this many ranges with their padding, and this many times their own.
LARGEST_PADDED, PADDED_SHARE = 10**7, 4
FEW_RANGES = 0.01  # share of all ranges
ZSTD = b"\x28\xb5\x2f\xfd"  # first bytes of what zstd has compressed
FAR = 100.0  # m, beyond the ranges of a scanner for robots

# Frame, smallest and greatest range, name of the program that sent its scans.
Scanner = tuple[str, float, float, str]


def scans_of(
    path: Path, topic: str, contents: Contents, frame: str | None, remarks: list[str]
) -> dict[str, Any]:
    """Return the fields of a `Recording` that come from the scans.

    Args:
        frame: of the scanner; None for the first one.
        remarks: to which remarks on the scanner, its angles and its ranges are added.

    Raises:
        RecordingError: for scans that cannot be used.
    """
    scanner, log_time, rows = _of_one_scanner(path, topic, contents, frame, remarks)
    stamps, _, given, scans = zip(*rows, strict=True)
    points = np.array([len(scan) for scan in scans])
    ranges = _padded(path, topic, scans, points)
    try:
        taken, doubts = bearings(given, points)
    except ValueError as error:
        raise RecordingError(
            f"{path}, topic {topic}: {error}; correct the program that sent the scans."
        ) from None
    low, high = np.float32(scanner[1]), np.float32(scanner[2])
    remarks += [*doubts, *_on_ranges(ranges, low, high)]
    ranges[~((ranges >= low) & (ranges <= high))] = np.inf
    return {
        "log_time": log_time,
        "stamp": np.array(stamps),
        "ranges": ranges,
        "points": points,
        "angle_min": taken[:, 0],
        "angle_increment": taken[:, 1],
        "frame": scanner[0],
    }


def _of_one_scanner(
    path: Path, topic: str, contents: Contents, frame: str | None, remarks: list[str]
) -> tuple[Scanner, Times, list[tuple[Any, ...]]]:
    """Return the chosen scanner, and the log times, stamps, angles and ranges of its scans.

    Args:
        frame: of the scanner; None for the first one.
        remarks: a remark is added if there are several scanners.
    """

    def fields(message: Any, _: int) -> tuple[Any, ...]:
        scanner = message.header.frame_id, message.range_min, message.range_max
        if math.isnan(message.range_min + message.range_max):
            raise ValueError("its smallest or greatest range is not a number")
        angles = Angles(message.angle_min, message.angle_max, message.angle_increment)
        return stamp_of(message), scanner, angles, np.asarray(message.ranges, np.float32)

    log_time, rows = decoded(path, topic, contents, fields)
    angles = np.array([(row[2].first, row[2].step) for row in rows])
    check_finite(path, topic, log_time, angles, "the angle of its first range, or between ranges,")
    # Recordings that were converted from ROS 1 name the program that sent a message.
    senders = (
        dict(message.channel.metadata).get("callerid", "") for message in contents.messages[topic]
    )
    scanners = [(*row[1], sender) for row, sender in zip(rows, senders, strict=True)]
    chosen = _choose_scanner(path, topic, scanners, frame, remarks)
    kept = [row for row, scanner in enumerate(scanners) if scanner == chosen]
    return chosen, log_time[kept], [rows[row] for row in kept]


def decoded(
    path: Path, topic: str, contents: Contents, fields: Callable[[Any, int], tuple[Any, ...]]
) -> tuple[Times, list[tuple[Any, ...]]]:
    """Return the log times of a topic, and the chosen fields of its messages.

    Args:
        fields: takes a decoded message and the time in ns when it was sent, and returns what is
            needed of it.
    """
    rows = []
    for index, (channel, log_time, sent, data) in enumerate(contents.messages[topic]):
        try:
            message = decode(data, channel.message_type)
            rows.append(fields(message, sent))
        except Exception as error:  # the bytes may be anything
            if data.startswith(ZSTD):
                raise RecordingError(
                    f"{path}, topic {topic} has messages that are compressed one by one "
                    f"(compression_mode: MESSAGE); convert its folder: {CONVERT}."
                ) from None
            raise RecordingError(
                f"{path}, topic {topic}, message {index} at {log_time / 1e9:.3f} s: it is not a "
                f"valid {channel.message_type} ({' '.join(str(error).split())}); record it again, "
                "or correct the program that sent it."
            ) from None
    return np.array([message.log_time for message in contents.messages[topic]]), rows


def check_finite(
    path: Path, topic: str, time: Times, values: NDArray[np.float64], name: str
) -> None:
    """Raise a `RecordingError` for a message with numbers beyond what any robot does.

    Args:
        time: [M] ns, log time of each message.
        values: [M, n], in m, radians and s.
    """
    wrong = np.flatnonzero(~(np.abs(values) < LARGEST).all(axis=1))
    if len(wrong):
        index = int(wrong[0])
        raise RecordingError(
            f"{path}, topic {topic}, message {index} at {time[index] / 1e9:.3f} s: {name} is not a "
            f"number below {LARGEST:g}; record it again, or correct the program that sent it."
        )


def _padded(
    path: Path, topic: str, scans: Sequence[NDArray[np.float32]], points: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Return scans as rows of the length of the longest, padded with infinity."""
    if not points.any():
        raise RecordingError(
            f"{path}, topic {topic}: no scan has a range; check that the scanner ran, and record "
            "again."
        )
    # One long scan makes all of them long.
    if len(scans) * points.max() > max(LARGEST_PADDED, PADDED_SHARE * points.sum()):
        raise RecordingError(
            f"{path}, topic {topic}: scans of {points.min()} to {points.max()} ranges; a scanner "
            "has about as many in each: record those of one scanner."
        )
    ranges = np.full((len(scans), points.max()), np.inf, np.float32)
    for row, scan in zip(ranges, scans, strict=True):
        row[: len(scan)] = scan
    return ranges


def _on_ranges(ranges: NDArray[np.float32], low: np.float32, high: np.float32) -> list[str]:
    """Return a remark on ranges that hardly are those of a scanner, in metres.

    Args:
        ranges: [N, P], of all scans, as they were sent.
    """
    returned = ranges[np.isfinite(ranges) & (ranges > 0)]
    inside = returned[(returned >= low) & (returned <= high)]
    if len(inside) < FEW_RANGES * len(returned):
        return [
            f"has {len(inside) / len(returned):.1%} of its ranges between range_min={low:g} and "
            f"range_max={high:g} m, and their median is {np.median(returned):g}: are they in mm?"
        ]
    if len(inside) and np.median(inside) > FAR:
        return [f"has ranges with a median of {np.median(inside):g} m: are they in mm?"]
    return []


def _choose_scanner(
    path: Path, topic: str, scanners: Sequence[Scanner], frame: str | None, remarks: list[str]
) -> Scanner:
    """Return the first scanner, or the first one with a frame.

    Args:
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
