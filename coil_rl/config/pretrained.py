"""Shipped policies: finished runs that are a part of the package, opened by their names.

Wherever a program takes the folder of a run to read, `pretrained:NAME` names one of these. The
files are checked by their SHA-256 before any of them is read.
"""

import hashlib
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

from coil_rl.errors import UserError, did_you_mean
from coil_rl.files import LARGEST_NUMBERS, read_file, read_text

PREFIX = "pretrained:"
CHECKSUMS, CARD = "checksums.json", "card.md"
LARGEST = 200_000  # bytes of a file of a shipped policy


def pretrained_names() -> list[str]:
    """Return the names of the shipped policies."""
    return sorted(_checksums())


def pretrained_card(name: str) -> str:
    """Return the card of a shipped policy: what it was trained for, and how well it does.

    Args:
        name: of the policy.

    Raises:
        UserError: for a name that does not exist, and for files that are not those that were
            shipped.
    """
    return read_text(folder_of(name) / CARD, LARGEST)


def run_folder(text: str | Path) -> Path:
    """Return the folder that a text names: that of a shipped policy for `pretrained:NAME`.

    Args:
        text: of the user.

    Raises:
        UserError: for a name that does not exist, and for files that are not those that were
            shipped.
    """
    if str(text).startswith(PREFIX):
        return folder_of(str(text).removeprefix(PREFIX))
    return Path(text).expanduser()


def folder_of(name: str) -> Path:
    """Return the folder of a shipped policy, whose files have been checked.

    Args:
        name: of the policy.

    Raises:
        UserError: for a name that does not exist, and for files that are not those that were
            shipped.
    """
    known = _checksums()
    if name not in known:
        raise UserError(
            f"{PREFIX}{name} does not exist; there are {', '.join(sorted(known))}"
            f"{did_you_mean(name, known)}"
        )
    folder = _place() / name
    for file, digest in known[name].items():
        path = folder / file
        content = read_file(path, LARGEST) if path.is_file() else b""
        if hashlib.sha256(content).hexdigest() != digest:
            raise UserError(
                f"{path} is not the file that was shipped: its SHA-256 is not {digest}; install "
                "coil-rl again"
            )
    return folder


def _place() -> Path:
    return Path(str(resources.files("coil_rl.policies")))


def _checksums() -> Mapping[str, Mapping[str, str]]:
    """Return the SHA-256 of each file by policy."""
    found: Mapping[str, Mapping[str, str]] = json.loads(
        read_text(_place() / CHECKSUMS, LARGEST_NUMBERS)
    )
    return found
