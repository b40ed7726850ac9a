"""Atomic writes: files and folders appear complete or not at all, also if the process is killed."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path with the same suffix that becomes `path` at the end of the block.

    Parents are made and an older file is replaced. If the block raises, the temporary file is removed.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = _temporary(path)
    try:
        yield unfinished
        _to_disk(unfinished)
        unfinished.replace(path)
        folder_to_disk(path.parent)
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
    finally:
        unfinished.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file with exactly one line break at its end, as `whole_file`."""
    with whole_file(path) as unfinished:
        unfinished.write_text(text.rstrip("\n") + "\n", encoding="utf-8")


@contextmanager
def whole_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` at the end of the block.

    Parents are made. If the block raises, the temporary folder is removed.

    Raises:
        OSError: if `path` exists and is not an empty folder.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = _temporary(path)
    unfinished.mkdir()
    try:
        yield unfinished
        for name in [*unfinished.rglob("*"), unfinished]:
            (folder_to_disk if name.is_dir() else _to_disk)(name)
        unfinished.rename(path)
        folder_to_disk(path.parent)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files of killed processes; no other process may be writing there."""
    for path in folder.iterdir():
        if re.fullmatch(r"\..+\.\d+(\.\w+)?", path.name):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def folder_to_disk(folder: Path) -> None:
    """Wait until the entries of a folder are on the disk."""
    if os.name != "nt":  # Windows cannot open a folder
        _to_disk(folder)


def _temporary(path: Path) -> Path:
    return path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
