"""Tables of numbers that take seconds to compute, kept in the user's cache folder.

A file is named after everything that its tables follow from, so that a later process with the same
input reads them within milliseconds, and one with another input, or another program, makes its own.
It holds arrays of numbers, with NumPy's checksums: one that is damaged, cut short or of another
kind is computed anew and replaced. A cache folder that cannot be used costs time and nothing else.
"""

import hashlib
import io
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from coil_rl.errors import UserError
from coil_rl.files import read_file, whole_file

SMALLEST, LARGEST = 500_000, 100_000_000  # bytes of tables that are kept
MOST_FILES = 16  # in the folder; those that were not used for the longest time are removed
SUFFIX = ".npz"

Tables = Mapping[str, Tensor]


def cache_folder() -> Path:
    """Return the folder for what can be made again, `coil-rl` in the user's cache folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "coil-rl"


def kept(name: str, source: Iterable[bytes], make: Callable[[], dict[str, Tensor]]) -> Tables:
    """Return the tables that `make` computes, read from the cache folder if they are there.

    Args:
        name: what they are, the beginning of the name of their file.
        source: everything that they follow from, the program included.
    """
    try:
        # Of digests, so that no part can be taken for some of another one.
        digests = b"".join(hashlib.sha256(part).digest() for part in source)
        file = cache_folder() / f"{name}_{hashlib.sha256(digests).hexdigest()[:32]}{SUFFIX}"
    except RuntimeError:  # there is no home
        return make()
    with suppress(OSError, ValueError, EOFError, BadZipFile):
        content = io.BytesIO(read_file(file, LARGEST + 1_000_000))
        with np.load(content, allow_pickle=False) as arrays:
            tables = {name: torch.from_numpy(arrays[name]) for name in arrays.files}
        os.utime(file)
        return tables
    made = make()
    if SMALLEST <= sum(table.nbytes for table in made.values()) <= LARGEST:
        with suppress(OSError, UserError):  # a file in the place of the folder
            _write(file, made)
    return made


def _write(file: Path, tables: Tables) -> None:
    """Write a file, and remove the oldest ones of the folder if it is full."""
    arrays: dict[str, Any] = {name: table.numpy() for name, table in tables.items()}
    with whole_file(file) as unfinished:
        np.savez(unfinished, **arrays)
    files = [path for path in file.parent.glob(f"*{SUFFIX}") if path.is_file()]
    newest = sorted(files, key=lambda path: path.stat().st_mtime, reverse=True)
    for path in newest[MOST_FILES:]:
        path.unlink(missing_ok=True)
