"""MCAP files and rosbag2 folders: reading and writing of encoded messages.

Recordings come from robots whose batteries run out and from disks that are full. So a file that
ends early is read as far as it goes, damaged chunks are skipped and counted, and everything that
cannot be used is refused in one sentence with a remedy.
"""

import hashlib
import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

import lz4.frame
import zstandard
from mcap import records
from mcap.exceptions import RecordLengthLimitExceeded
from mcap.reader import SeekingReader
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import CompressionType, Writer

from coil_rl.envs.recordings.folders import CONVERT, MAGIC, RecordingError, files_of
from coil_rl.envs.recordings.messages import definition, encode
from coil_rl.files import open_regular, whole_file

# If a recording is cut off, only the last chunk is lost: ten seconds of a small scanner.
CHUNK = 128 * 1024  # bytes

# A file unpacks to at most this many bytes, and this many for each of its own.
UNPACKED, UNPACKED_SHARE = 20_000_000, 50

COMPRESSIONS = ("zstd", "lz4", "")  # of chunks

# First bytes of other files with the name of a recording, what they are, and the remedy.
_OTHER_FORMATS = {
    b"version https://git-lfs": (
        "a Git LFS pointer, not the recording",
        "fetch it with git lfs pull",
    ),
    b"#ROSBAG V": (
        "a ROS 1 bag",
        "convert it: rosbags-convert --src FILE --dst OTHER --dst-storage mcap",
    ),
    b"SQLite format 3\0": ("the SQLite storage of a ROS 2 bag", f"convert its folder: {CONVERT}"),
    b"\x28\xb5\x2f\xfd": (
        "compressed as a whole with zstd",
        "unpack it: zstd -d FILE -o OTHER.mcap",
    ),
    b"\x1f\x8b": ("compressed as a whole with gzip", "unpack it first"),
    b"\x04\x22\x4d\x18": ("compressed as a whole with lz4", "unpack it first"),
    b"PK\x03\x04": ("a zip archive", "unpack it first"),
}


class Channel(NamedTuple):
    """A topic with its message type and the type's definition.

    Attributes:
        topic: name of the topic.
        message_type: empty if the file has none.
        encoding: of the messages.
        language: of the definition.
        definition: of the message type.
        metadata: keys and values, such as the quality of service that ROS 2 offers.
    """

    topic: str
    message_type: str
    encoding: str = "cdr"
    language: str = "ros2msg"
    definition: bytes = b""
    metadata: tuple[tuple[str, str], ...] = ()


class RawMessage(NamedTuple):
    """An encoded message.

    Attributes:
        channel: topic and type.
        log_time: ns, when it was recorded.
        publish_time: ns, when it was sent.
        data: the encoded message.
    """

    channel: Channel
    log_time: int
    publish_time: int
    data: bytes


@dataclass
class Contents:
    """Contents of a recording.

    Attributes:
        messages: by topic, as they are in the files.
        channels: of all topics.
        notes: metadata records by name.
        attachments: by name.
        remarks: what the metadata of a folder say and its files do not.
        cut_off: whether a file ends early.
        damage: the damaged places that were skipped.
        lost: number of messages that damage made unreadable, by topic; a topic is missing if the
            number is unknown.
    """

    messages: dict[str, list[RawMessage]]
    channels: list[Channel] = field(default_factory=list)
    notes: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, records.Attachment] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    cut_off: bool = False
    damage: list[str] = field(default_factory=list)
    lost: dict[str, int] = field(default_factory=dict)


def read_messages(
    path: str | os.PathLike[str],
    topics: Collection[str] | None = None,
    types: Collection[str] = (),
) -> Contents:
    """Read a recording from start to end, with its checksums verified.

    One that ends early is read as far as it goes, and damaged chunks are skipped. Another kind of
    file, or damage after which no record can be found, is a `RecordingError`.

    Args:
        path: an MCAP file, or the folder of a rosbag2 recording in MCAP files.
        topics: topics to read; None for all. A missing one has no messages.
        types: message types whose topics are read too.
    """
    contents = Contents({topic: [] for topic in topics or ()})
    folder = files_of(Path(path))
    for file in folder.files:
        _read_file(file, topics, types, contents)
    contents.remarks = [*folder.remarks, *_miscounted(folder.counts, contents)]
    contents.channels = list(dict.fromkeys(contents.channels))
    return contents


def digest(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a recording, in hexadecimal.

    Args:
        path: an MCAP file, or the folder of a rosbag2 recording, of whose files the concatenation
            is taken.
    """
    sha256 = hashlib.sha256()
    for file in files_of(Path(path)).files:
        _check_format(file)
        with open_regular(file) as stream:
            while block := stream.read(CHUNK):
                sha256.update(block)
    return sha256.hexdigest()


class RecordingWriter:
    """Collects messages, and writes them as an MCAP file at the end of a `with` block.

    The messages are ordered by time. Nothing is written if the block raises. The file appears
    complete or not at all, and replaces an existing one. Equal messages make equal bytes. See
    `read_recording` for an example.

    Args:
        path: of the file; its folder is made if it is missing.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._messages: list[RawMessage] = []
        self._metadata: dict[str, dict[str, str]] = {}
        self._attachments: dict[str, tuple[str, bytes, tuple[int, int] | None]] = {}

    def add(self, topic: str, message_type: str, time: int, fields: Mapping[str, Any]) -> None:
        """Add a message.

        Args:
            topic: of the message.
            message_type: such as "geometry_msgs/msg/Twist".
            time: ns, of the recording and of the sending.
            fields: by name, each a number, text, sequence or nested mapping; zero or empty if
                missing. An unknown field is a `ValueError`.
        """
        channel = Channel(topic, message_type, definition=definition(message_type))
        self.copy(RawMessage(channel, time, time, encode(message_type, fields)))

    def copy(self, message: RawMessage) -> None:
        """Add an encoded message, such as one of another recording."""
        self._messages.append(message)

    def describe(self, name: str, entries: Mapping[str, str]) -> None:
        """Add a metadata record.

        Args:
            name: of the record.
            entries: its keys and values.
        """
        self._metadata[name] = dict(sorted(entries.items()))

    def attach(
        self, name: str, media_type: str, data: bytes, times: tuple[int, int] | None = None
    ) -> None:
        """Add an attachment, such as a configuration.

        Args:
            name: of the attachment.
            media_type: such as "text/yaml".
            data: its content.
            times: ns, of creation and of logging; by default both are the time of the first
                message.
        """
        self._attachments[name] = media_type, data, times

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, traceback: object) -> None:
        if error is not None:
            return
        with whole_file(self.path) as unfinished, unfinished.open("wb") as stream:
            self._write(Writer(stream, CHUNK, CompressionType.ZSTD, enable_data_crcs=True))

    def _write(self, writer: Writer) -> None:
        writer.start(profile="ros2", library="coil-rl")
        for name, entries in sorted(self._metadata.items()):
            writer.add_metadata(name, entries)
        start = min((message.log_time for message in self._messages), default=0)
        for name, (media_type, data, times) in sorted(self._attachments.items()):
            writer.add_attachment(*(times or (start, start)), name, media_type, data)

        schemas: dict[tuple[str, str, bytes], int] = {}
        channels: dict[Channel, int] = {}
        for channel in sorted({message.channel for message in self._messages}):
            schema = (channel.message_type, channel.language, channel.definition)
            if channel.message_type and schema not in schemas:
                schemas[schema] = writer.register_schema(*schema)
            about = channel.encoding, schemas.get(schema, 0), dict(channel.metadata)
            channels[channel] = writer.register_channel(channel.topic, *about)
        in_order = sorted(self._messages, key=lambda message: (message.log_time, message.channel))
        for message in in_order:
            channel_id = channels[message.channel]
            writer.add_message(channel_id, message.log_time, message.data, message.publish_time)
        writer.finish()


def _miscounted(counts: Mapping[str, int], contents: Contents) -> list[str]:
    """Return remarks on topics of which the metadata of a folder claim other numbers of messages.

    Args:
        counts: that the metadata claim, by topic.
    """
    if contents.cut_off or contents.damage:
        return []
    remarks = []
    for topic, messages in contents.messages.items():
        claimed = counts.get(topic, len(messages))
        if claimed != len(messages):
            remarks.append(
                f"has {len(messages)} messages on topic {topic}, and its metadata claim {claimed}: "
                "copy all its files, or let ROS count again: ros2 bag reindex FOLDER"
            )
    return remarks


def _read_file(
    file: Path, topics: Collection[str] | None, types: Collection[str], contents: Contents
) -> None:
    """Add the contents of a file.

    Args:
        topics: topics to read; None for all.
        types: message types whose topics are read too.
    """
    size, complete = _check_format(file)
    before = {topic: len(messages) for topic, messages in contents.messages.items()}
    damage = len(contents.damage)
    selected: dict[int, tuple[Channel, list[RawMessage]]] = {}
    schemas: dict[int, records.Schema] = {}
    with open_regular(file) as stream:
        for record in _records(file, stream, size, complete, contents):
            if type(record) is records.Message:
                if record.channel_id in selected:
                    channel, messages = selected[record.channel_id]
                    messages.append(
                        RawMessage(channel, record.log_time, record.publish_time, record.data)
                    )
            elif type(record) is records.Schema:
                schemas[record.id] = record
            elif type(record) is records.Channel:
                channel = _channel(record, schemas.get(record.schema_id))
                contents.channels.append(channel)
                wanted = topics is None or channel.topic in topics
                if wanted or channel.message_type in types:
                    selected[record.id] = channel, contents.messages.setdefault(channel.topic, [])
            elif type(record) is records.Metadata:
                contents.notes[record.name] = dict(record.metadata)
            elif type(record) is records.Attachment:
                contents.attachments[record.name] = record
        if len(contents.damage) > damage:
            _count_lost(contents, before, _summary(stream))


def _channel(record: records.Channel, schema: records.Schema | None) -> Channel:
    """Return a channel of a file, whose messages may have no type."""
    metadata = tuple(record.metadata.items())
    if schema is None:
        return Channel(record.topic, "", record.message_encoding, "", b"", metadata)
    return Channel(
        record.topic, schema.name, record.message_encoding, schema.encoding, schema.data, metadata
    )


def _count_lost(contents: Contents, before: Mapping[str, int], summary: Summary) -> None:
    """Count the messages of a damaged file that could not be read.

    Args:
        contents: with the messages that could be read.
        before: number of messages of each topic that come from other files.
        summary: of the file; without statistics the number is unknown.
    """
    if not summary.statistics:
        return
    written = summary.statistics.channel_message_counts
    for topic, messages in contents.messages.items():
        numbers = [number for number, each in summary.channels.items() if each.topic == topic]
        total = sum(written.get(number, 0) for number in numbers)
        read = len(messages) - before.get(topic, 0)
        contents.lost[topic] = contents.lost.get(topic, 0) + max(0, total - read)


def _records(
    file: Path, stream: BinaryIO, size: int, complete: bool, contents: Contents
) -> Iterator[Any]:
    """Yield the records of a file, of its chunks too.

    Damaged chunks are skipped. They and an early end are noted in the contents.

    Args:
        stream: its bytes.
        size: number of bytes.
        complete: whether the end of the file is there.
    """
    reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=size)
    read = reader.records
    left = UNPACKED + UNPACKED_SHARE * size
    while True:
        start, record = stream.tell(), None
        try:
            record = next(read, None)
            if record is None:
                return
            parts = [record]
            if type(record) is records.Chunk:
                unpacked = _unpacked(file, record, left)
                left -= len(unpacked.data)
                parts = breakup_chunk(unpacked, validate_crc=True)
        except RecordingError:
            raise
        # Damaged bytes raise almost any exception in the libraries below.
        except Exception as error:
            end = stream.tell()
            if not complete and (end >= size or isinstance(error, RecordLengthLimitExceeded)):
                contents.cut_off = True
                return
            summary = _summary(stream)
            _check_compression(file, start, record, summary)
            places = [chunk.chunk_start_offset for chunk in summary.chunk_indexes]
            places += [each.offset for each in summary.metadata_indexes]
            places += [each.offset for each in summary.attachment_indexes]
            following = [place for place in places if place > start]
            if record:
                following.append(end)
            # A wrong checksum of the whole file does not tell where the damage is.
            whole = isinstance(error, CRCValidationError) and type(error.record) is records.DataEnd
            if whole or not (places or following):
                reason = " ".join(str(error).split()) or type(error).__name__
                raise RecordingError(
                    f"{file} is damaged before byte {end} ({reason}); copy it again from where it "
                    "was recorded, or save what is left with: mcap recover FILE -o OTHER.mcap."
                ) from None
            contents.damage.append(f"byte {start}")
            if not following:
                return
            stream.seek(min(following))
            read = StreamReader(
                stream, skip_magic=True, emit_chunks=True, record_size_limit=size
            ).records
            # The damage may hide the channels of the messages that follow.
            parts = [*summary.schemas.values(), *summary.channels.values()]
        yield from parts


def _check_compression(file: Path, start: int, record: Any, summary: Summary) -> None:
    """Raise a `RecordingError` if a chunk cannot be unpacked because nobody here knows how.

    Args:
        start: place of the chunk in the file.
        record: the chunk, or another record, or None if that is damaged itself.
        summary: of the file; what it says of the chunk goes before what the chunk itself says,
            which may be damaged.
    """
    named = {each.chunk_start_offset: each.compression for each in summary.chunk_indexes}
    compression = named.get(start, getattr(record, "compression", ""))
    if compression not in COMPRESSIONS:
        raise RecordingError(
            f"{file} has chunks in the compression {compression[:40]!r}, but zstd and lz4 are "
            "read; record it, or write it again, in one of these."
        )


def _unpacked(file: Path, chunk: records.Chunk, left: int) -> records.Chunk:
    """Return a chunk without compression.

    Args:
        file: that it is from, for a message.
        left: number of bytes that it may unpack to; more are a `RecordingError`.
    """
    if chunk.uncompressed_size > left:
        raise RecordingError(
            f"{file} has {file.stat().st_size:,} bytes, but unpacks to more than {UNPACKED_SHARE} "
            "times as many; no recording of a robot does."
        )
    most = chunk.uncompressed_size + 1
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            data = reader.read(most)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=most)
    else:
        data = chunk.data
    if chunk.compression and len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk does not unpack to {chunk.uncompressed_size} bytes")
    return replace(chunk, compression="", data=data)


def _summary(stream: BinaryIO) -> Summary:
    """Return the index at the end of a file, empty if it is missing or damaged."""
    stream.seek(0)
    try:
        return SeekingReader(stream).get_summary() or Summary()
    except Exception:  # its bytes may be anything
        return Summary()


def _check_format(file: Path) -> tuple[int, bool]:
    """Return the size of an MCAP file in bytes, and whether its end is there.

    Any other file is a `RecordingError`.
    """
    try:
        with open_regular(file) as stream:
            start = stream.read(32)
            size = stream.seek(0, os.SEEK_END)
            stream.seek(max(0, size - len(MAGIC)))
            complete = stream.read() == MAGIC and size > len(MAGIC)
    except OSError as error:
        raise RecordingError(
            f"{file} cannot be read ({error.strerror}); give the path of an MCAP file."
        ) from None
    if not start:
        raise RecordingError(f"{file} is empty; copy it again from where it was recorded.")
    if MAGIC.startswith(start[: len(MAGIC)]):
        return size, complete
    for magic, (description, remedy) in _OTHER_FORMATS.items():
        if start.startswith(magic):
            raise RecordingError(f"{file} is {description}; {remedy}.")
    raise RecordingError(
        f"{file} is not an MCAP file: it begins with {start[:8].hex(' ')}; give one that is."
    )
