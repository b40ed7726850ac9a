"""Files of a run: read with a limit, and written complete or not at all.

A folder of a run may come from anybody, and a process may be killed while it writes one.
"""

import errno
import os
import re
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from coil_rl.errors import UserError

SWEEP = "multirun.yaml"  # Hydra's file in the folder of a sweep
FAILED_JOBS = "failed_jobs.txt"  # in the folder of a sweep, a line for each
LARGEST_NUMBERS = 1_000_000  # bytes of a small file, such as guide_return.json
LARGEST_TABLE = 200_000_000  # bytes of a table, such as metrics.csv
BLOCK = 65_536  # bytes that are read of a file without a size
_OPTIONS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Open a file to read its bytes.

    Args:
        path: of the file; a link to a file is one.

    Raises:
        OSError: if there is none, or it is a folder, a pipe, a socket or a device; `strerror` says
            which.
    """
    # A pipe without a writer would wait here, were it not for O_NONBLOCK.
    descriptor = os.open(path, _OPTIONS)
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", os.fspath(path))
        return open(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_file(path: str | os.PathLike[str], largest: int) -> bytes:
    """Return the bytes of a regular file, see `open_regular`.

    Args:
        largest: allowed size, in bytes.

    Raises:
        OSError: as `open_regular`, and for a larger file.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        # Some files of the system have no size before they are read.
        content = b"" if size > largest else file.read(max(size, BLOCK))
    if max(size, len(content)) > largest:
        raise OSError(errno.EINVAL, f"it has more than {largest:,} bytes", os.fspath(path))
    return content


def read_text(path: str | os.PathLike[str], largest: int) -> str:
    """Return the text of a file in UTF-8, as `read_file`.

    Args:
        largest: allowed size, in bytes.
    """
    return read_file(path, largest).decode("utf-8-sig")


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path with the same suffix that becomes `path` at the end of the block.

    Parents are made and an older file is replaced. If the block raises, the temporary file is
    removed.

    Raises:
        UserError: if there is a folder in its place, or a file in that of a parent.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        obstacle = next((place for place in path.parents if place.is_file()), path.parent)
        raise UserError(
            f"{obstacle} is a file, but a folder is to be made there; remove it"
        ) from error
    unfinished = temporary(path)
    try:
        yield unfinished
        if path.is_dir():
            raise UserError(f"{path} is a folder, but a file is to be written there; remove it")
        _to_disk(unfinished)
        unfinished.replace(path)
        folder_to_disk(path.parent)
    except OSError as error:
        error.filename = error.filename or str(path)
        raise
    finally:
        unfinished.unlink(missing_ok=True)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file with exactly one line break at its end, as `whole_file`.

    Args:
        path: of the file.
        text: its content.
    """
    with whole_file(path) as unfinished:
        unfinished.write_text(text.rstrip("\n") + "\n", encoding="utf-8")


def temporary(path: Path) -> Path:
    """Return the path beside `path` under which this process makes it."""
    return path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files of killed processes; no other process may be writing there."""
    for path in folder.iterdir():
        if re.fullmatch(r"\..+\.\d+(\.\w+)?", path.name):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def folder_to_disk(folder: Path) -> None:
    """Wait until the entries of a folder are on the disk."""
    if os.name != "nt":  # Windows cannot open a folder
        _to_disk(folder)


def _to_disk(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
