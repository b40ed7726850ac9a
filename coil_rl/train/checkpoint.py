"""Files that hold states: whole, unaltered and free of code, or refused."""

from __future__ import annotations

import hashlib
import io
import sys
from pathlib import Path
from typing import Any

import torch

from coil_rl.errors import UserError
from coil_rl.files import folder_to_disk, whole_file

NEWEST, PREVIOUS = "checkpoint.pt", "checkpoint_previous.pt"
DIGITS = 64  # of a SHA-256


def save(state: Any, path: Path) -> None:
    """Write a state so that at every moment either the old file or the new one is there.

    The file is what `torch.save` makes, a zip archive, with the SHA-256 of all before it as the archive's comment:
    `torch.load` still reads it, and the sum cannot be another file's.
    """
    content = _content(state)
    with whole_file(path) as unfinished:
        unfinished.write_bytes(content)


def load(path: Path, device: str = "cpu") -> Any:
    """Read a state, running no code from the file.

    Raises:
        UserError: if there is no such file, or it is not to a byte what `save` wrote.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}; give the folder of a run that coil-train has finished")
    content = path.read_bytes()
    if _sum(content[:-DIGITS]) != content[-DIGITS:]:
        raise UserError(f"{path} is not a whole checkpoint: its checksum does not fit; train again or use another")
    try:
        return torch.load(io.BytesIO(content), map_location=device, weights_only=True)
    except Exception as error:
        raise UserError(
            f"{path} is not a whole checkpoint ({type(error).__name__}); train again or use another"
        ) from error


def save_newest(state: Any, folder: Path) -> None:
    """Write a run's checkpoint and keep the one before it; at every moment one of the two is whole."""
    content = _content(state)
    with whole_file(folder / NEWEST) as unfinished:
        unfinished.write_bytes(content)
        if (folder / NEWEST).exists():
            (folder / NEWEST).replace(folder / PREVIOUS)


def load_newest(folder: Path) -> Any | None:
    """A run's newest checkpoint; if it is broken, the one before it, which then takes its name.

    Says on standard error if it had to go back.

    Returns:
        The state; None if the run was stopped before its first checkpoint.

    Raises:
        UserError: if what there is cannot be used.
    """
    newest, previous = folder / NEWEST, folder / PREVIOUS
    if not newest.exists() and not previous.exists():
        return None
    try:
        return load(newest)
    except UserError as error:
        reason = str(error) if newest.exists() else f"{newest} is missing"
        try:
            state = load(previous)
        except UserError:
            raise UserError(
                f"neither {newest} nor {previous} is a whole checkpoint; "
                "put one of them back from a copy, or train again in another folder"
            ) from error
    print(f"{reason.split(';')[0]}; going back to {previous.name}", file=sys.stderr)
    # Or else the next rotation would replace the good one by the broken one.
    previous.replace(newest)
    folder_to_disk(folder)
    return state


def _content(state: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    # The last two bytes of an archive without a comment are the comment's length.
    archive = buffer.getvalue()[:-2] + DIGITS.to_bytes(2, "little")
    return archive + _sum(archive)


def _sum(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()
