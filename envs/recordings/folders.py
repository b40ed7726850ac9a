"""Folders of rosbag2: which files belong to a recording, and what their metadata claim.

The metadata are written by another program than the files, and after them: they may be missing,
name no storage (as after a reindexing), or count messages of a longer recording. The files decide.
"""

import re
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from coil_rl.files import open_regular, read_file

MAGIC = b"\x89MCAP0\r\n"
LARGEST_METADATA = 1_000_000  # bytes of the metadata.yaml of a folder
CONVERT = "rosbags-convert --src FOLDER --dst OTHER --dst-storage mcap"

# The metadata are written by a program, so a few of their lines are found without a YAML parser.
STORAGE = re.compile(r"^\s*storage_identifier:[ \t]*[\"']?(\w*)", re.MULTILINE)
LISTED = re.compile(r"^\s*relative_file_paths:\s*\n((?:\s*-[ \t]+.*\n?)+)", re.MULTILINE)
LISTED_IN_A_LINE = re.compile(r"^\s*relative_file_paths:[ \t]*\[([^\]\n]*)\]", re.MULTILINE)
COUNTED = re.compile(r"^\s*topics_with_message_count:\s*\n", re.MULTILINE)
OF_A_TOPIC = re.compile(r"^\s*-[ \t]+(?=topic_metadata:|message_count:)", re.MULTILINE)
NAME = re.compile(r"^\s*name:[ \t]*[\"']?([^\s\"']+)", re.MULTILINE)
NUMBER = re.compile(r"^\s*message_count:[ \t]*(\d{1,18})\s*$", re.MULTILINE)


class RecordingError(ValueError):
    """A recording that cannot be used; the message is one sentence for the user."""


@dataclass
class Folder:
    """Files of a recording.

    Attributes:
        files: in the order of the metadata; the file itself for a recording that is no folder.
        counts: number of messages by topic that the metadata claim.
        remarks: what the metadata say and the files do not.
    """

    files: list[Path]
    counts: dict[str, int] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)


def files_of(path: Path) -> Folder:
    """Return the files of a recording.

    Args:
        path: an MCAP file, or the folder of a rosbag2 recording.

    Raises:
        RecordingError: for a folder whose metadata or files are missing, or that holds no MCAP.
    """
    if not path.is_dir():
        return Folder([path])
    metadata = path / "metadata.yaml"
    try:
        text = read_file(metadata, LARGEST_METADATA).decode()
    except (OSError, UnicodeDecodeError):
        raise RecordingError(
            f"{path} is a folder without a readable metadata.yaml; let ROS write it: ros2 bag "
            "reindex FOLDER."
        ) from None
    names = _listed(text)
    if not names:
        raise RecordingError(
            f"{metadata} lists no files; let ROS write it: ros2 bag reindex FOLDER."
        )
    files = [path / name for name in dict.fromkeys(names)]
    storage = STORAGE.search(text)
    if storage and storage[1] not in ("", "mcap") and not any(map(_is_mcap, files)):
        raise RecordingError(
            f"{path} is a recording in {storage[1]}, not in MCAP; convert it: {CONVERT}."
        )
    for file in files:
        if not file.is_file():
            raise RecordingError(
                f"{metadata} lists {file.name}, which is missing; copy all its files."
            )
    return Folder(files, _counts(text), _remarks(path, names))


def _listed(text: str) -> list[str]:
    """Return the names of the files that the metadata list."""
    block, line = LISTED.search(text), LISTED_IN_A_LINE.search(text)
    entries: list[str] = []
    if block:
        entries = [entry.strip().removeprefix("-") for entry in block[1].splitlines()]
    elif line:
        entries = line[1].split(",")
    # Older versions of ROS put the folder's own name before the file's.
    names = [Path(entry.strip(" \"'")).name for entry in entries]
    return [name for name in names if name]


def _counts(text: str) -> dict[str, int]:
    """Return the number of messages of each topic that the metadata claim."""
    counts: dict[str, int] = {}
    section = COUNTED.split(text, maxsplit=1)[1:]
    for part in OF_A_TOPIC.split(section[0])[1:] if section else ():
        name, number = NAME.search(part), NUMBER.search(part)
        if name and number:
            counts[name[1]] = int(number[1])
    return counts


def _remarks(path: Path, names: list[str]) -> list[str]:
    """Return remarks on files that the metadata list twice, or not at all."""
    remarks = []
    twice = [name for name, number in Counter(names).items() if number > 1]
    if twice:
        remarks.append(f"lists {', '.join(twice)} more than once in its metadata; it is read once")
    others = sorted({file.name for file in path.glob("*.mcap")} - set(names))
    if others:
        remarks.append(
            f"holds {', '.join(others)}, which its metadata do not list and which is not read; "
            "let ROS list it: ros2 bag reindex FOLDER"
        )
    return remarks


def _is_mcap(file: Path) -> bool:
    """Return whether a file begins as MCAP does."""
    try:
        with open_regular(file) as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False
