"""Files and folders that appear whole or not at all, also where the process is killed or the power fails."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A name to write to; it becomes `path` when the block ends, or vanishes if the block raises.

    Args:
        path: the file to be; its folder is made, an older file is replaced.

    Yields:
        A name in the same folder and with the same ending, by which image writers choose their format.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield unfinished
        _to_disk(unfinished)
        unfinished.replace(path)
        folder_to_disk(path.parent)
    finally:
        unfinished.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """A file of text, which ends with its last line, written as by `whole_file`."""
    with whole_file(path) as unfinished:
        unfinished.write_text(text.rstrip("\n") + "\n", encoding="utf-8")


@contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A folder to write files into; it becomes `path` when the block ends, or vanishes if the block raises.

    Args:
        path: the folder to be, which may not exist or be empty; its parents are made.

    Yields:
        An empty folder beside it.

    Raises:
        OSError: if there is something at `path`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    unfinished.mkdir()
    try:
        yield unfinished
        for name in [*unfinished.rglob("*"), unfinished]:
            (folder_to_disk if name.is_dir() else _to_disk)(name)
        unfinished.rename(path)
        folder_to_disk(path.parent)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def folder_to_disk(folder: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    if os.name != "nt":  # where a folder cannot be opened
        _to_disk(folder)


def remove_unfinished(folder: Path) -> None:
    """Remove what killed processes had not finished writing; nobody else may be writing there now."""
    for path in folder.iterdir():
        if re.fullmatch(r"\..+\.\d+(\.\w+)?", path.name):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
