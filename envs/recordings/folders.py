"""Folders of rosbag2: which files belong to a recording, and what their metadata claim.

The metadata are written by another program than the files, and after them: they may be missing,
name no storage (as after a reindexing), or count messages of a longer recording. The files decide.
"""

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from coil_rl.files import open_regular
from coil_rl.plain_yaml import read_yaml

MAGIC = b"\x89MCAP0\r\n"
LARGEST_METADATA = 1_000_000  # bytes; a day in files of a minute has 300,000
CONVERT = "rosbags-convert --src FOLDER --dst OTHER --dst-storage mcap"


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
        said = read_yaml(metadata, LARGEST_METADATA)["rosbag2_bagfile_information"]
        # Older versions of ROS put the folder's own name before the file's.
        names = [Path(name).name for name in said["relative_file_paths"] or ()]
        topics = said.get("topics_with_message_count") or ()
        named = [each for each in topics if "topic_metadata" in each]  # not in the oldest ones
        counts = {each["topic_metadata"]["name"]: each["message_count"] for each in named}
    except Exception:  # it may hold anything
        raise RecordingError(
            f"{path} is a folder without a readable metadata.yaml; let ROS write it: ros2 bag "
            "reindex FOLDER."
        ) from None
    if not names:
        raise RecordingError(
            f"{metadata} lists no files; let ROS write it: ros2 bag reindex FOLDER."
        )
    files, storage = [path / name for name in dict.fromkeys(names)], said.get("storage_identifier")
    if storage not in (None, "", "mcap") and not any(map(_is_mcap, files)):
        raise RecordingError(
            f"{path} is a recording in {storage}, not in MCAP; convert it: {CONVERT}."
        )
    for file in files:
        if not file.is_file():
            raise RecordingError(
                f"{metadata} lists {file.name}, which is missing; copy all its files."
            )
    return Folder(files, counts, _remarks(path, names))


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
