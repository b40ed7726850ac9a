"""Test of files that may come from anybody."""

import os
import re
import socket

import pytest

from coil_rl.envs.regular_files import open_regular, read_regular


def test_file_is_read_up_to_its_limit(tmp_path):
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_bytes(b"12345")
    link.symlink_to(file)
    assert read_regular(file, 5) == read_regular(link, 5) == b"12345"
    with pytest.raises(OSError, match="it has more than 4 bytes"):
        read_regular(file, 4)
    # Files of the system have no size.
    with pytest.raises(OSError, match="it has more than 4 bytes"):
        read_regular("/proc/self/status", 4)


def test_other_things_than_files_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
        for path in ("pipe", "socket", "/dev/zero", "/dev/null", ".", "none", "x" * 300):
            with pytest.raises(OSError, match=re.escape(path[:50])):
                open_regular(path)
            with pytest.raises(OSError, match=re.escape(path[:50])):
                read_regular(path, 10**6)


def test_sparse_file_of_any_size_is_not_read(tmp_path):
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(OSError, match="more than 1,000 bytes"):
        read_regular(tmp_path / "sparse", 1000)
