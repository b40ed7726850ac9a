"""The contract of an exported policy: what its numbers mean, read and checked.

`contract.json` lies beside the file of the policy. Whoever runs the policy needs nothing else: the
inputs in their order, their units, what is remembered between two steps, and the checksum of the
file that all of this is about.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import read_file, read_text

FORMAT, VERSION = "coil-rl policy", 1
CONTRACT, ONNX, TORCH, DRIVER = "contract.json", "policy.onnx", "policy.pt2", "drive.py"
LARGEST_CONTRACT, LARGEST_POLICY = 10_000_000, 500_000_000  # bytes
REMEDY = "export the policy again: coil-export run=RUN"


def checksum(content: bytes) -> str:
    """Return the SHA-256 of some bytes in hexadecimal digits.

    Args:
        content: the bytes.
    """
    return hashlib.sha256(content).hexdigest()


def place_of(file: str | Path) -> Path:
    """Return the file of an exported policy for its own name or that of its folder.

    Args:
        file: `policy.onnx`, or the folder that holds it.
    """
    path = Path(file).expanduser()
    return path / ONNX if path.is_dir() else path


def read_contract(file: Path) -> tuple[dict[str, Any], bytes]:
    """Return the contract of an exported policy, and the content of its file.

    Args:
        file: `policy.onnx`, with `contract.json` beside it.

    Raises:
        UserError: for a file that is missing, damaged, of another version, or not the one that the
            contract is about.
    """
    path = file.parent / CONTRACT
    for each in (file, path):
        if not each.is_file():
            raise UserError(
                f"{each} does not exist, but an exported policy is {ONNX} with {CONTRACT} beside "
                f"it; {REMEDY}"
            )
    with file_of_a_run(path, REMEDY):
        contract = json.loads(read_text(path, LARGEST_CONTRACT))
        found = contract["format"], contract["version"]
        digest = str(contract["files"][ONNX]["sha256"])
        _check(contract)
    if found != (FORMAT, VERSION):
        raise UserError(
            f"{path} has the format {found[0]!r} in version {found[1]}, but this program reads "
            f"{FORMAT!r} in version {VERSION}; {REMEDY}"
        )
    with file_of_a_run(file, REMEDY):
        content = read_file(file, LARGEST_POLICY)
    if checksum(content) != digest:
        raise UserError(
            f"{file} is not the file that {path} is about: its SHA-256 is {checksum(content)}, not "
            f"{digest}; put both files of one export there"
        )
    return contract, content


def _check(contract: Mapping[str, Any]) -> None:
    """Read everything that is used once, so that what is missing is an error here."""
    for entry in contract["inputs"]:
        _ = entry["name"], list(entry["key"]), list(map(int, entry["shape"])), entry["dtype"]
    for entry in contract["state"]:
        _ = entry["input"], entry["output"], list(entry["shape"]), entry["dtype"], entry["first"]
    action = contract["outputs"][0]
    _ = list(action["shape"]), list(action["space"]["shape"]), action["space"]["dtype"]
    _ = contract["guide"]["place"], contract["env"]["title"]
