"""Files that hold states: whole or not there at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from coil_rl.errors import UserError
from coil_rl.files import whole_file


def save(state: Any, path: Path) -> None:
    """Write a state so that at every moment either the old file or the new one is there."""
    with whole_file(path) as unfinished, unfinished.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())


def load(path: Path, device: str = "cpu") -> Any:
    """Read a state, running no code from the file.

    Raises:
        UserError: if there is no such file or it is not a whole checkpoint.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}; give the folder of a run that coil-train has finished")
    try:
        return torch.load(path, map_location=device, weights_only=True)
    except Exception as error:
        raise UserError(
            f"{path} is not a whole checkpoint ({type(error).__name__}); train again or use another"
        ) from error
