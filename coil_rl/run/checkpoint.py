"""Checkpoint files: complete, unaltered and free of code, or refused."""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import folder_to_disk, read_file, whole_file
from coil_rl.foreign.remembered import loaded
from coil_rl.output import say
from coil_rl.run.folder import check_same

if TYPE_CHECKING:
    from coil_rl.run.run import Run

NEWEST, PREVIOUS = "checkpoint.pt", "checkpoint_previous.pt"
DIGITS = 64  # of a SHA-256
PUT_BACK = "put the files of the run back, or train again in another folder"
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


def go_on(run: Run, load: Callable[[dict[str, Any]], object] = lambda state: None) -> bool:
    """Load the last intact checkpoint of a run; return whether there is one.

    A run that was made longer has the checkpoint of the shorter one.

    Args:
        run: that goes on.
        load: restores the state; by default the configuration is checked only.

    Raises:
        UserError: if it is damaged, or belongs to a run with another configuration.
    """
    state = load_newest(run.folder)
    if state is None:
        return False
    file = run.folder / NEWEST
    with file_of_a_run(file, PUT_BACK):
        saved, ours = dict(state["identity"]), dict(run.identity)
        frames = saved.get("budget.frames")
        if frames in (run.budget.frames, *run.budget.stages):
            for each in (saved, ours):
                each.pop("budget.frames", None)
                each.pop("budget.stages", None)
        check_same(saved, ours, f"{file} belongs to a run", PUT_BACK)
        load(state)
    return True


def check_parameters(state: Any, update: int, name: str = "learner") -> None:
    """Raise a `UserError` if a tensor of a nested state holds NaN; bounds may be infinite."""
    if isinstance(state, Mapping):
        for key, value in state.items():
            check_parameters(value, update, f"{name}/{key}")
    elif isinstance(state, torch.Tensor) and state.is_floating_point() and state.isnan().any():
        raise UserError(f"{name} is nan after update {update}")


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
