"""The commands of a recording: choice of their topic, and the messages as numbers."""

from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.envs.recordings.mcap_files import Contents
from coil_rl.envs.recordings.messages import COMMANDS, command_of
from coil_rl.envs.recordings.scans import LARGEST, decoded

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

    Args:
        contents: of the recording; messages of other types than the first are left out.
        remarks: a remark is added on messages that are left out.
    """
    messages = contents.messages[topic]
    kind = messages[0].channel.message_type
    of_kind = [message for message in messages if message.channel.message_type == kind]
    if len(of_kind) < len(messages):
        remarks.append(
            f"has commands of several types on topic {topic}, of which the "
            f"{len(of_kind)} of {kind} are read, and {len(messages) - len(of_kind)} others are not"
        )
        contents.messages[topic] = of_kind
    time, rows = decoded(path, topic, contents, command_of)
    commands = np.array(rows, dtype=np.float64)
    usable = np.asarray((np.abs(commands) < LARGEST).all(axis=1))
    if not usable.all():
        remarks.append(
            f"has {(~usable).sum()} of {len(usable)} commands on topic {topic} that are no numbers "
            f"below {LARGEST:g}, and they are left out"
        )
    if not usable.any():
        return {}
    return {
        "commands": (commands[usable], time[usable]),
        "command_topic": topic,
        "command_type": kind,
    }
