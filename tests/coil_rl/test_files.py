from pathlib import Path

import pytest

from coil_rl.errors import UserError
from coil_rl.files import remove_unfinished, whole_file, whole_folder, write_text


def test_file_and_folder_appear_complete(tmp_path: Path) -> None:
    path = tmp_path / "new folder" / "table.csv"
    with whole_file(path) as unfinished:
        unfinished.write_text("half")
        assert not path.exists()
        assert unfinished.suffix == ".csv"
    assert path.read_text() == "half"
    folder = tmp_path / "new folder" / "data"
    with whole_folder(folder) as unfinished:
        (unfinished / "inner").mkdir()
        (unfinished / "inner" / "numbers").write_text("1 2")
        assert not folder.exists()
    assert (folder / "inner" / "numbers").read_text() == "1 2"
    assert set(path.parent.iterdir()) == {path, folder}


def test_error_keeps_the_old_file_and_leaves_no_folder(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("old")

    def write_file() -> None:
        with whole_file(path) as unfinished:
            unfinished.write_text("half")
            raise RuntimeError("the disk is full")

    def write_folder() -> None:
        with whole_folder(tmp_path / "data") as unfinished:
            (unfinished / "half").write_text("1")
            raise RuntimeError("the disk is full")

    for write in (write_file, write_folder):
        with pytest.raises(RuntimeError, match="the disk is full"):
            write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_folder_with_contents_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "mine").write_text("1")
    with pytest.raises(OSError, match="data"), whole_folder(tmp_path / "data"):
        pass
    assert [path.name for path in (tmp_path / "data").iterdir()] == ["mine"]


def test_what_is_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("1")
    (tmp_path / "folder").mkdir()
    for context, path, message in (
        (whole_file, "folder", "folder is a folder, but a file is to be written there; remove it"),
        (whole_file, "file/below", "file is a file, but a folder is to be made there; remove it"),
        (whole_folder, "file", "file is a file, but a folder is to be made there; remove it"),
        (whole_folder, "file/below/it", "file is a file, but a folder is to be made there; remove it"),
    ):
        with pytest.raises(UserError, match=message), context(tmp_path / path) as unfinished:
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
