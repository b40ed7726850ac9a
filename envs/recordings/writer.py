"""Writing MCAP recordings: the same messages make the same bytes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.writer import CompressionType, Writer

from coil_rl.envs.recordings.cdr import definition
from coil_rl.envs.recordings.mcap_files import Source, Stored

# Of a recording that is cut off only the last chunk is lost: ten seconds of a small scanner.
CHUNK = 128 * 1024  # bytes


class RecordingWriter:
    """Collects messages and writes them as an MCAP file in the order of their times once the block ends.

    Nothing is written if the block raises, and nobody ever meets half a recording under its name.

    Args:
        path: the file to be; its folder is made, an older file is replaced.

    Example:
        >>> import tempfile
        >>> from coil_rl.envs.recordings.ros_messages import Twist
        >>> path = Path(tempfile.mkdtemp()) / "drive.mcap"
        >>> with RecordingWriter(path) as drive:
        ...     drive.add("/cmd_vel", "geometry_msgs/msg/Twist", time=0, data=Twist(0.15, 0.0).to_bytes())
        >>> path.exists()
        True
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._messages: list[Stored] = []
        self._metadata: dict[str, dict[str, str]] = {}
        self._attachments: dict[str, tuple[str, bytes]] = {}

    def add(self, topic: str, kind: str, *, time: int, data: bytes) -> None:
        """Add a message.

        Args:
            topic: where it belongs.
            kind: its type, such as "geometry_msgs/msg/Twist".
            time: ns, when it was recorded and sent.
            data: as CDR.

        Raises:
            ValueError: for a type that is not known.
        """
        self.copy(Stored(Source(topic, kind, definition=definition(kind)), time, time, data))

    def copy(self, message: Stored) -> None:
        """Add a message as it stands in another recording."""
        self._messages.append(message)

    def describe(self, name: str, entries: Mapping[str, str]) -> None:
        """Add a metadata record."""
        self._metadata[name] = dict(entries)

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Add a file, such as a configuration."""
        self._attachments[name] = media_type, data

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is not None:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = self.path.with_name(f".{self.path.stem}.{os.getpid()}{self.path.suffix}")
        try:
            with unfinished.open("wb") as stream:
                self._write(Writer(stream, CHUNK, CompressionType.ZSTD, enable_data_crcs=True))
                stream.flush()
                os.fsync(stream.fileno())
            unfinished.replace(self.path)
        finally:
            unfinished.unlink(missing_ok=True)

    def _write(self, writer: Writer) -> None:
        writer.start(profile="ros2", library="coil-rl")
        for name, entries in sorted(self._metadata.items()):
            writer.add_metadata(name, dict(sorted(entries.items())))
        first = min((message.log_time for message in self._messages), default=0)
        for name, (media_type, data) in sorted(self._attachments.items()):
            writer.add_attachment(first, first, name, media_type, data)

        schemas: dict[tuple[str, str, bytes], int] = {}
        channels: dict[Source, int] = {}
        for source in sorted({message.source for message in self._messages}):
            schema = (source.kind, source.language, source.definition)
            if source.kind and schema not in schemas:
                schemas[schema] = writer.register_schema(*schema)
            channels[source] = writer.register_channel(source.topic, source.encoding, schemas.get(schema, 0))
        for message in sorted(self._messages, key=lambda message: (message.log_time, message.source)):
            writer.add_message(channels[message.source], message.log_time, message.data, message.publish_time)
        writer.finish()
