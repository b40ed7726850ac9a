"""MCAP files and rosbag2 directories: the messages in them, and in one sentence what is wrong with a file."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.exceptions import RecordLengthLimitExceeded
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

MAGIC = b"\x89MCAP0\r\n"

# What else is found under the name of a recording: its first bytes, what it is, and what to do.
_OTHERS = {
    b"version https://git-lfs": ("is a Git LFS pointer, not the recording", "fetch it with git lfs pull"),
    b"#ROSBAG V": ("is a ROS 1 bag", "convert it: rosbags-convert --src FILE --dst OTHER --dst-storage mcap"),
    b"SQLite format 3\0": (
        "is the SQLite storage of a ROS 2 bag",
        "convert its folder: rosbags-convert --src FOLDER --dst OTHER --dst-storage mcap",
    ),
    b"\x28\xb5\x2f\xfd": ("is compressed as a whole with zstd", "unpack it: zstd -d FILE -o OTHER.mcap"),
    b"\x1f\x8b": ("is compressed as a whole with gzip", "unpack it first"),
    b"\x04\x22\x4d\x18": ("is compressed as a whole with lz4", "unpack it first"),
    b"PK\x03\x04": ("is a zip archive", "unpack it first"),
}


class RecordingError(ValueError):
    """A recording cannot be used; the message is one sentence for whoever made it."""


class Source(NamedTuple):
    """Where messages of a topic come from.

    Attributes:
        topic: its name.
        kind: type of its messages, such as "sensor_msgs/msg/LaserScan"; empty where the file does not say.
        encoding: of the messages, such as "cdr".
        language: of the definition, such as "ros2msg".
        definition: of the type.
    """

    topic: str
    kind: str
    encoding: str = "cdr"
    language: str = "ros2msg"
    definition: bytes = b""


class Stored(NamedTuple):
    """A message as it is stored.

    Attributes:
        source: where it comes from.
        log_time: ns, when it was recorded.
        publish_time: ns, when it was sent.
        data: its bytes.
    """

    source: Source
    log_time: int
    publish_time: int
    data: bytes


class Contents(NamedTuple):
    """What a recording holds.

    Attributes:
        sources: of all topics.
        messages: of the topics asked for, each topic's in the order of their log times.
        cut_off: whether the recording ends too early.
        notes: its metadata records, by name.
    """

    sources: list[Source]
    messages: dict[str, list[Stored]]
    cut_off: bool
    notes: dict[str, dict[str, str]]


def read_messages(path: str | os.PathLike[str], topics: Collection[str] | None = None) -> Contents:
    """Read a recording from beginning to end, checksums verified.

    Args:
        path: an MCAP file, or the directory of a rosbag2 recording in such files.
        topics: names of those whose messages to keep; None keeps all. One that is not there has no messages.

    Raises:
        RecordingError: if this is no recording, or a damaged one. One that only ends too early is read as far as it
            goes.
    """
    sources: dict[Source, None] = {}
    messages: dict[str, list[Stored]] = {topic: [] for topic in topics or ()}
    notes: dict[str, dict[str, str]] = {}
    cut_off = False
    for file in _files(Path(path)):
        cut_off |= _read_file(file, topics, sources, messages, notes)
    for stored in messages.values():
        stored.sort(key=lambda message: message.log_time)
    return Contents(list(sources), messages, cut_off, notes)


def digest(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a recording, in hexadecimal; of a directory, of all its files one after the other.

    Raises:
        RecordingError: if there is no such recording.
    """
    whole = hashlib.sha256()
    for file in _files(Path(path)):
        _check_kind(file)
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                whole.update(block)
    return whole.hexdigest()


def _read_file(
    file: Path,
    topics: Collection[str] | None,
    sources: dict[Source, None],
    messages: dict[str, list[Stored]],
    notes: dict[str, dict[str, str]],
) -> bool:
    """Add what a file holds; returns whether it ends too early."""
    size, whole = _check_kind(file)
    wanted: dict[int, tuple[Source, list[Stored]]] = {}
    schemas: dict[int, Schema] = {}
    last = None
    with file.open("rb") as stream:
        records = StreamReader(stream, validate_crcs=True, record_size_limit=size).records
        try:
            for record in records:
                if type(record) is Message:
                    last = record
                    if record.channel_id in wanted:
                        source, kept = wanted[record.channel_id]
                        kept.append(Stored(source, record.log_time, record.publish_time, record.data))
                elif type(record) is Schema:
                    schemas[record.id] = record
                elif type(record) is Channel:
                    source = _source(record, schemas)
                    sources[source] = None
                    if topics is None or source.topic in topics:
                        wanted[record.id] = source, messages.setdefault(source.topic, [])
                elif type(record) is Metadata:
                    notes[record.name] = dict(record.metadata)
        # Damaged bytes make the libraries beneath raise almost anything.
        except Exception as error:
            if not whole and (stream.tell() >= size or isinstance(error, RecordLengthLimitExceeded)):
                return True
            where = f"byte {stream.tell()}" + (f", after {last.log_time / 1e9:.3f} s" if last else "")
            what = " ".join(str(error).split()) or type(error).__name__
            raise RecordingError(
                f"{file} is damaged before {where} ({what}); copy it anew from where it was "
                "recorded, or save what is left with: mcap recover FILE -o OTHER.mcap."
            ) from None
    return False


def _source(channel: Channel, schemas: dict[int, Schema]) -> Source:
    if channel.schema_id == 0:
        return Source(channel.topic, "", channel.message_encoding, "", b"")
    schema = schemas[channel.schema_id]
    return Source(channel.topic, schema.name, channel.message_encoding, schema.encoding, schema.data)


def _check_kind(file: Path) -> tuple[int, bool]:
    """The size of an MCAP file in bytes, and whether it ends as one does; whatever else it is, is refused."""
    try:
        with file.open("rb") as stream:
            start = stream.read(32)
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(0, size - len(MAGIC)))
            whole = stream.read() == MAGIC and size > len(MAGIC)
    except OSError as error:
        raise RecordingError(f"{file} cannot be read ({error.strerror}); give the path of an MCAP file.") from None
    if not start:
        raise RecordingError(f"{file} is empty; copy it anew from where it was recorded.")
    if MAGIC.startswith(start[: len(MAGIC)]):
        return size, whole
    for magic, (what, remedy) in _OTHERS.items():
        if start.startswith(magic):
            raise RecordingError(f"{file} {what}; {remedy}.")
    raise RecordingError(f"{file} is not an MCAP file: it begins with {start[:8].hex(' ')}; give one that is.")


def _files(path: Path) -> Iterator[Path]:
    """The file, or those of which a rosbag2 directory says that it consists."""
    if not path.is_dir():
        yield path
        return
    try:
        # A machine wrote it, so two of its lines are found without a parser.
        text = (path / "metadata.yaml").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise RecordingError(
            f"{path} is a folder without a readable metadata.yaml; give one MCAP file, or let ROS write that file: "
            "ros2 bag reindex FOLDER."
        ) from None
    storage = re.search(r"^\s*storage_identifier:\s*[\"']?(\w*)", text, re.MULTILINE)
    listed = re.search(r"^\s*relative_file_paths:\s*\n((?:\s*-\s+.*\n?)+)", text, re.MULTILINE)
    if storage and storage[1] != "mcap":
        raise RecordingError(
            f"{path} is a recording in {storage[1]}, not in MCAP; convert it: "
            "rosbags-convert --src FOLDER --dst OTHER --dst-storage mcap."
        )
    if not listed:
        raise RecordingError(f"{path / 'metadata.yaml'} lists no files; let ROS write it: ros2 bag reindex FOLDER.")
    for line in listed[1].splitlines():
        # Older versions of ROS write the folder's own name before the file's.
        file = path / Path(line.strip().removeprefix("-").strip(" \"'")).name
        if not file.is_file():
            raise RecordingError(f"{path / 'metadata.yaml'} lists {file.name}, which is not there; copy all its files.")
        yield file
