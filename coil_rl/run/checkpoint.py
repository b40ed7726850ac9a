"""Checkpoint files: complete, unaltered and free of code, or refused."""

import hashlib
import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.errors import UserError
from coil_rl.files import folder_to_disk, read_file, whole_file
from coil_rl.foreign.remembered import loaded
from coil_rl.output import say

NEWEST, PREVIOUS = "checkpoint.pt", "checkpoint_previous.pt"
DIGITS = 64  # of a SHA-256
LARGEST_FILE = 16 * 2**30  # bytes


def save(state: Any, path: Path) -> None:
    """Write a state atomically.

    The file is the zip archive of `torch.save` with the SHA-256 of its content as the archive's
    comment, so that `torch.load` can read it too.
    """
    content = _content(state)
    with whole_file(path) as unfinished:
        unfinished.write_bytes(content)


def load(path: Path, device: str = "cpu") -> Any:
    """Read a state without running code, and with no more memory than its size.

    Raises:
        UserError: for a file that is not exactly what `save` wrote.
    """
    if not path.is_file():
        raise UserError(
            f"there is no file {path}; give the folder of a run that coil-train has finished"
        )
    try:
        content = read_file(path, LARGEST_FILE)
    except OSError as error:
        raise UserError(
            f"{path} cannot be read ({error.strerror}); give a file that coil-train wrote"
        ) from error
    if _checksum(content[:-DIGITS]) != content[-DIGITS:]:
        raise UserError(f"{path} is damaged: its checksum is wrong; train again or use another")
    try:
        _check_archive(content)
        return loaded(io.BytesIO(content), device)
    except Exception as error:
        raise UserError(
            f"{path} is damaged ({type(error).__name__}); train again or use another"
        ) from error


def put_weights(policy: TensorDictModuleBase, state: Any, path: Path) -> None:
    """Put the weights that were read from a file into a policy.

    Raises:
        UserError: if they do not fit the policy, or are not finite.
    """
    own = policy.state_dict()
    for name, value in state.items() if isinstance(state, Mapping) else ():
        known = own.get(name)
        both = isinstance(value, Tensor) and isinstance(known, Tensor)
        if both and value.dtype != known.dtype:  # torch would make another policy of them
            raise UserError(
                f"{path} holds {name} as {value.dtype}, not {known.dtype}, so that it is no policy "
                "of this run; train again or use another"
            )
    try:
        policy.load_state_dict(state)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    except (RuntimeError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} does not fit the networks in {path.parent / 'config.yaml'}; one of them was "
            "changed after the run"
        ) from error
    if not all(parameter.isfinite().all() for parameter in policy.parameters()):
        raise UserError(
            f"{path} holds weights that are NaN or infinite; train again or use another"
        )


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
    say(f"{reason.split(';')[0]}; using {previous.name}", error=True)
    # Otherwise the next checkpoint would replace the intact file by the damaged one.
    previous.replace(newest)
    folder_to_disk(folder)
    return state


def _check_archive(content: bytes) -> None:
    """Raise an error for an archive that takes more memory than its size, before that is taken.

    Deflated entries may unpack to a thousand times their size, and entries may share their bytes.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise ValueError("an entry is compressed")
        if sum(entry.file_size for entry in entries) > len(content):
            raise ValueError("its entries are larger than the file")


def _content(state: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    # The last two bytes of an archive without a comment are the length of the comment.
    archive = buffer.getvalue()[:-2] + DIGITS.to_bytes(2, "little")
    return archive + _checksum(archive)


def _checksum(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()
