"""Tables of numbers that take seconds to compute, kept in the user's cache folder.

A file is named after everything that its tables follow from, so that a later process with the same
input reads them within milliseconds, and one with another input, or another program, makes its own.
It holds numbers only, and their digest: one that is damaged, cut short or of another kind is
computed anew and replaced. A cache folder that cannot be used costs time and nothing else.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from coil_rl.envs.regular_files import read_regular

SMALLEST, LARGEST = 500_000, 100_000_000  # bytes of tables that are kept
MOST_FILES = 16  # in the folder; those that were not used for the longest time are removed
SUFFIX = ".tables"
DIGEST = 64  # characters at the start of a file
KINDS = ("int16", "int32", "int64", "float32", "float64")

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
        file = cache_folder() / f"{name}_{_digest(source)[:32]}{SUFFIX}"
    except RuntimeError:  # there is no home
        return make()
    with suppress(OSError, ValueError, KeyError, TypeError):
        tables = unpacked(read_regular(file, LARGEST + 1_000_000))
        os.utime(file)
        return tables
    made = make()
    if SMALLEST <= sum(table.nbytes for table in made.values()) <= LARGEST:
        with suppress(OSError):
            _write(file, packed(made))
    return made


def packed(tables: Tables) -> bytes:
    """Return tables as bytes: a digest of the rest, a line that lists them, and their numbers.

    Args:
        tables: by name.
    """
    arrays = {name: table.contiguous().numpy() for name, table in tables.items()}
    listed = {name: [array.dtype.name, *array.shape] for name, array in arrays.items()}
    line = json.dumps(listed).encode() + b"\n"
    content = line + b"".join(array.tobytes() for array in arrays.values())
    return hashlib.sha256(content).hexdigest().encode() + content


def unpacked(content: bytes) -> dict[str, Tensor]:
    """Return the tables that `packed` made bytes of.

    Args:
        content: the bytes.

    Raises:
        ValueError: if they are others.
    """
    digest, rest = content[:DIGEST], memoryview(content)[DIGEST:]
    if hashlib.sha256(rest).hexdigest().encode() != digest:
        raise ValueError("the content does not have the digest that is at its start")
    end = content.index(b"\n", DIGEST) + 1
    listed: dict[str, list[Any]] = json.loads(content[DIGEST:end])
    tables, place = {}, end
    for name, (kind, *shape) in listed.items():
        if kind not in KINDS:
            raise ValueError(f"table {name} is of {kind}, not one of {', '.join(KINDS)}")
        count = int(np.prod(shape, dtype=np.int64))
        numbers = np.frombuffer(content, kind, count, place)
        tables[name] = torch.from_numpy(numbers.reshape(shape).copy())
        place += numbers.nbytes
    return tables


def _digest(parts: Iterable[bytes]) -> str:
    """Return the digest of some bytes, of which none may be taken for parts of others."""
    total = hashlib.sha256()
    for part in parts:
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()


def _write(file: Path, content: bytes) -> None:
    """Write a file whole or not at all, and remove the oldest ones of the folder if it is full."""
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_name(f".{file.stem}.{os.getpid()}{SUFFIX}")
    try:
        unfinished.write_bytes(content)
        unfinished.replace(file)
    finally:
        unfinished.unlink(missing_ok=True)
    files = [path for path in file.parent.glob(f"*{SUFFIX}") if path.is_file()]
    newest = sorted(files, key=lambda path: path.stat().st_mtime, reverse=True)
    for path in newest[MOST_FILES:]:
        path.unlink(missing_ok=True)
