"""Checkpoint files: complete, unaltered and free of code, or refused."""

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
    """Write a state atomically.

    The file is the zip archive of `torch.save` with the SHA-256 of its content as the archive's
    comment, so that `torch.load` can read it too.
    """
    content = _content(state)
    with whole_file(path) as unfinished:
        unfinished.write_bytes(content)


def load(path: Path, device: str = "cpu") -> Any:
    """Read a state without running code.

    A file that is not exactly what `save` wrote is a `UserError`.
    """
    if not path.is_file():
        raise UserError(
            f"there is no file {path}; give the folder of a run that coil-train has finished"
        )
    content = path.read_bytes()
    if _checksum(content[:-DIGITS]) != content[-DIGITS:]:
        raise UserError(f"{path} is damaged: its checksum is wrong; train again or use another")
    try:
        return torch.load(io.BytesIO(content), map_location=device, weights_only=True)
    except Exception as error:
        raise UserError(
            f"{path} is damaged ({type(error).__name__}); train again or use another"
        ) from error


def save_newest(state: Any, folder: Path) -> None:
    """Write the checkpoint of a run and keep the previous one.

    At any moment one of the two is intact.
    """
    content = _content(state)
    with whole_file(folder / NEWEST) as unfinished:
        unfinished.write_bytes(content)
        if (folder / NEWEST).exists():
            (folder / NEWEST).replace(folder / PREVIOUS)


def load_newest(folder: Path) -> Any | None:
    """Return the newest checkpoint of a run; None before the first one.

    If it is damaged, the previous one is returned.

    The use of the previous one is reported on standard error. If both are damaged, that is a
    `UserError`.
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
                f"both {newest} and {previous} are damaged; put one of them back from a copy, or "
                "train again in another folder"
            ) from error
    print(f"{reason.split(';')[0]}; using {previous.name}", file=sys.stderr)
    # Otherwise the next checkpoint would replace the intact file by the damaged one.
    previous.replace(newest)
    folder_to_disk(folder)
    return state


def _content(state: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    # The last two bytes of an archive without a comment are the length of the comment.
    archive = buffer.getvalue()[:-2] + DIGITS.to_bytes(2, "little")
    return archive + _checksum(archive)


def _checksum(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()
