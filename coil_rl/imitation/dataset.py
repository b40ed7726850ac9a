"""Data sets of what guides said, as folders."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from tensordict import TensorDict, TensorDictBase

from coil_rl.errors import UserError
from coil_rl.files import whole_folder

SUMS = "SHA256SUMS"  # as `sha256sum --check` reads it


def save(dataset: TensorDictBase, folder: str | os.PathLike[str]) -> None:
    """Write a data set as a new folder, which appears whole or not at all.

    The folder is what `TensorDict.memmap` makes, one file an entry, and the SHA-256 of each file.

    Raises:
        UserError: if the folder exists.
    """
    folder = Path(folder)
    if folder.exists():
        raise UserError(f"{folder} exists already; give another folder, or remove it")
    with whole_folder(folder) as unfinished:
        dataset.cpu().memmap(unfinished)
        (unfinished / SUMS).write_text("".join(f"{total}  {name}\n" for name, total in _sums(unfinished).items()))


def load(folder: str | os.PathLike[str]) -> TensorDictBase:
    """Read a data set into memory, running no code from it.

    Raises:
        UserError: if there is no such folder, or it is not to a byte what `save` wrote.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}; give one that holds a data set")
    try:
        lines = [line.split("  ", 1) for line in (folder / SUMS).read_text().splitlines()]
        # Without this, tensordict fills up what is missing from the files with zeros, and writes those into them.
        if {name: total for total, name in lines} != _sums(folder):
            raise UserError(f"{folder} is not a whole data set: its checksums do not fit; take another copy of it")
        return TensorDict.load_memmap(folder, allow_pickle=False).clone()
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise UserError(f"{folder} is not a data set ({type(error).__name__}); give the folder of one") from error


def _sums(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != SUMS)
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
