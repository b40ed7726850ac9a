"""The commands of a recording: choice of their topic, and the messages as numbers."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.envs.recordings.mcap_files import Contents
from coil_rl.envs.recordings.messages import COMMANDS, command_of, stamp_of
from coil_rl.envs.recordings.recording import AT_ONCE, Recording, arrivals
from coil_rl.envs.recordings.scans import LARGEST, decoded

MOST = 0.5  # share of the commands
ADDED = "/coil/"  # topics that coil-replay adds to a copy: what policies would have done


def command_topic(wanted: str, contents: Contents, remarks: list[str]) -> str | None:
    """Return the topic whose commands are read; None for none.

    It is the topic that is wanted if there are commands on it, or else the only one that has some,
    such as `/drive` of a car that is steered by Ackermann messages.

    Args:
        contents: of the recording; messages on `wanted` are commands.
        remarks: a remark is added for another topic than the one that is wanted, or for others
            besides it.
    """
    others = []
    for topic, messages in contents.messages.items():
        commands = messages and messages[0].channel.message_type in COMMANDS
        if commands and topic != wanted and not topic.startswith(ADDED):
            others.append(topic)
    others.sort()
    if contents.messages.get(wanted):
        if others:
            remarks.append(
                f"has commands on {wanted}, which are read, and on {', '.join(others)}; choose "
                "with command=TOPIC"
            )
        return wanted
    kinds = [channel.message_type for channel in contents.channels if channel.topic == wanted]
    missing = f"has no command on topic {wanted}"
    if len(others) == 1:
        remarks.append(f"{missing}; those on {others[0]} are read instead")
        return others[0]
    if others:
        remarks.append(f"{missing}; choose with command={' or command='.join(others)}")
    elif set(kinds) & set(COMMANDS):
        remarks.append(f"{missing}, so there is no recorded steering")
    return None


def commands_of(path: Path, topic: str, contents: Contents, remarks: list[str]) -> dict[str, Any]:
    """Return the fields of a `Recording` that come from its commands.

    A command of another type than the first, or one that is no number, is NaN: none is known from
    there on.

    Args:
        contents: of the recording.
        remarks: a remark is added on such messages.
    """
    messages = contents.messages[topic]
    kind = messages[0].channel.message_type
    time, rows = decoded(path, topic, contents, partial(_fields, kind))
    stamps, commands = np.array([row[0] for row in rows]), np.array([row[1:] for row in rows])
    others = sum(message.channel.message_type != kind for message in messages)
    if others:
        remarks.append(
            f"has commands of several types on topic {topic}, of which the "
            f"{len(messages) - others} of {kind} are read; where one of the {others} others was "
            "the last, there is no recorded steering"
        )
    usable = np.asarray((np.abs(commands) < LARGEST).all(axis=1))
    wrong = int((~usable).sum()) - others
    if wrong:
        remarks.append(
            f"has {wrong} of {len(usable)} commands on topic {topic} that are no numbers below "
            f"{LARGEST:g}; where one was the last, there is no recorded steering"
        )
    if not usable.any():
        return {}
    commands[~usable] = np.nan
    return {
        "commands": (commands, arrivals(stamps, time)),
        "command_topic": topic,
        "command_type": kind,
    }


def _fields(kind: str, message: Any, sent: int) -> tuple[float, ...]:
    """Return the time in ns when a command was sent, and its two numbers; NaN for another type."""
    stamp = stamp_of(message) if hasattr(message, "header") else sent
    numbers = command_of(message) if message.__msgtype__ == kind else (np.nan, np.nan)
    return (stamp, *numbers)


def spread(recording: Recording) -> Recording:
    """Return a recording whose commands are spread over the scans with which they were logged.

    A recorder that writes late and many messages at once gives commands without a stamp one time.
    """
    late, turn = recording.log_time - recording.arrival, recording.turn * 1e9
    if recording.commands is None or not late.max() > turn > 0:
        return recording
    commands, times = recording.commands
    log_time, arrival = recording.log_time, recording.arrival
    begins = np.flatnonzero(np.diff(log_time, prepend=log_time[0] - turn) > AT_ONCE * turn)
    of_burst = log_time[begins]
    middle = (of_burst[1:] + log_time[begins[1:] - 1]) / 2
    burst = np.searchsorted(middle, times)
    if (np.abs(times - of_burst[burst]) > AT_ONCE * turn).mean() > MOST:
        return recording  # these were not late
    start = arrival[begins]
    end = np.append(start[1:], arrival[-1] + turn)
    rank = np.arange(len(times)) - np.searchsorted(burst, burst)
    share = (rank + 0.5) / np.bincount(burst, minlength=len(start))[burst]
    since = (share * (end - start)[burst]).astype(np.int64)
    return replace(recording, commands=(commands, start[burst] + since))
