import os
import re
import socket
from pathlib import Path

import pytest

from coil_rl.errors import UserError
from coil_rl.files import open_regular, read_file, remove_unfinished, whole_file, write_text


def test_file_appears_complete(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "table.csv"
    with whole_file(path) as unfinished:
        unfinished.write_text("half")
        assert not path.exists()
        assert unfinished.suffix == ".csv"
    assert path.read_text() == "half"
    assert set(path.parent.iterdir()) == {path}


def test_error_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old")

    def write_file() -> None:
        with whole_file(path) as unfinished:
            unfinished.write_text("half")
            raise RuntimeError("the disk is full")

    with pytest.raises(RuntimeError, match="the disk is full"):
        write_file()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("1")
    (tmp_path / "folder").mkdir()
    for path, message in (
        ("folder", "folder is a folder, but a file is to be written there; remove it"),
        ("file/below", "file is a file, but a folder is to be made there; remove it"),
        ("file/below/it", "file is a file, but a folder is to be made there; remove it"),
    ):
        with pytest.raises(UserError, match=message), whole_file(tmp_path / path) as unfinished:
            unfinished.touch()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize("end", ["", "\n", "\n\n"])
def test_text_ends_with_one_line_break(tmp_path: Path, end: str) -> None:
    write_text(tmp_path / "page.md", f"één\ntwo{end}")
    assert (tmp_path / "page.md").read_bytes() == "één\ntwo\n".encode()


def test_unfinished_files_of_killed_processes_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".data.123" / "inner").mkdir(parents=True)
    (tmp_path / ".table.123.csv").write_text("half")
    (tmp_path / "table.csv").write_text("whole")
    remove_unfinished(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["table.csv"]


def test_file_is_read_up_to_its_limit(tmp_path):
    file, link = tmp_path / "file", tmp_path / "link"
    file.write_bytes(b"12345")
    link.symlink_to(file)
    assert read_file(file, 5) == read_file(link, 5) == b"12345"
    with pytest.raises(OSError, match="it has more than 4 bytes"):
        read_file(file, 4)
    # Files of the system have no size.
    with pytest.raises(OSError, match="it has more than 4 bytes"):
        read_file("/proc/self/status", 4)


def test_other_things_than_files_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
        for path in ("pipe", "socket", "/dev/zero", "/dev/null", ".", "none", "x" * 300):
            with pytest.raises(OSError, match=re.escape(path[:50])):
                open_regular(path)
            with pytest.raises(OSError, match=re.escape(path[:50])):
                read_file(path, 10**6)


def test_sparse_file_of_any_size_is_not_read(tmp_path):
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(OSError, match="more than 1,000 bytes"):
        read_file(tmp_path / "sparse", 1000)
