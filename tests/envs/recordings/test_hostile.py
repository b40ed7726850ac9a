"""Recordings of somebody who means harm: small files that take any time or memory."""

import os
import time
import tracemalloc

import numpy as np
import pytest
from drives import scan, store
from mcap.writer import CompressionType, Writer

from coil_rl.envs.recordings.folders import RecordingError
from coil_rl.envs.recordings.mcap_files import digest, read_messages
from coil_rl.envs.recordings.messages import SCAN, definition
from coil_rl.envs.recordings.reading import read_recording


@pytest.fixture(autouse=True)
def limits():
    """A test that takes seconds, or hundreds of megabytes, has failed."""
    start = time.monotonic()
    tracemalloc.start()
    yield
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 300e6
    assert time.monotonic() - start < 20


def bomb(path, compression, size):
    """A recording with a message of zeros."""
    with path.open("wb") as stream:
        writer = Writer(stream, 1, compression)
        writer.start()
        schema = writer.register_schema(SCAN, "ros2msg", definition(SCAN))
        writer.add_message(writer.register_channel("/scan", "cdr", schema), 0, bytes(size), 0)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_small_file_does_not_unpack_to_a_large_one(tmp_path, compression):
    tracemalloc.stop()  # the file is made in memory
    path = bomb(tmp_path / "a.mcap", compression, 100_000_000)
    tracemalloc.start()
    assert path.stat().st_size < 500_000
    with pytest.raises(RecordingError, match="unpacks to more than 50 times as many"):
        read_messages(path)
    assert len(read_messages(bomb(path, compression, 10**6)).messages["/scan"]) == 1


def test_one_long_scan_does_not_make_all_scans_long(tmp_path):
    short = {**scan(0), "ranges": np.ones(1, np.float32)}
    long = {**scan(0), "ranges": np.ones(100_000, np.float32)}
    path = store(tmp_path / "a.mcap", long, *[short] * 200)
    with pytest.raises(RecordingError, match="scans of 1 to 100000 ranges"):
        read_recording(path)


@pytest.mark.parametrize("read", [read_recording, digest, read_messages])
def test_pipes_and_devices_are_refused(tmp_path, read):
    os.mkfifo(tmp_path / "pipe.mcap")
    for path in (tmp_path / "pipe.mcap", "/dev/zero", "/dev/null"):
        with pytest.raises(RecordingError, match="it is a pipe or a device, not a file"):
            read(path)
    os.mkfifo(tmp_path / "metadata.yaml")
    with pytest.raises(RecordingError, match="folder without a readable metadata"):
        read(tmp_path)
