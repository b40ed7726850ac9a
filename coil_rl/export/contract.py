"""The contract of an exported policy: what its numbers mean, read and checked.

`contract.json` lies beside the file of the policy. Whoever runs the policy needs nothing else: the
inputs in their order, their units, what is remembered between two steps, and the checksum of the
file that all of this is about.
"""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, model_validator

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import read_file
from coil_rl.record import json_file

FORMAT, VERSION = "coil-rl policy", 1
CONTRACT, ONNX, TORCH, DRIVER = "contract.json", "policy.onnx", "policy.pt2", "drive.py"
ADVICE = "guide_action"  # input for the actions of guides that are outside
LARGEST_CONTRACT, LARGEST_POLICY = 10_000_000, 500_000_000  # bytes
LARGEST_ENTRY = 100_000_000  # numbers of an input or output
REMEDY = "export the policy again: coil-export run=RUN"


def checksum(content: bytes) -> str:
    """Return the SHA-256 of some bytes in hexadecimal digits.

    Args:
        content: the bytes.
    """
    return hashlib.sha256(content).hexdigest()


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
        text = read_file(path, LARGEST_CONTRACT)
        contract = json.loads(text)
        found = contract["format"], contract["version"]
        digest = str(contract["files"][ONNX]["sha256"])
        json_file(CONTRACT, _Contract, REMEDY).parse(text)
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


def _number_type(name: str) -> str:
    if np.dtype(name).kind not in "fiub":
        raise ValueError(f"{name} is no type of numbers")
    return name


def _shape(sizes: list[int]) -> list[int]:
    if any(size < 1 for size in sizes) or math.prod(sizes) > LARGEST_ENTRY:
        raise ValueError(f"{sizes} is no shape of at most {LARGEST_ENTRY} numbers")
    return sizes


Shape = Annotated[list[int], AfterValidator(_shape)]
NumberType = Annotated[str, AfterValidator(_number_type)]


class _Numbers(BaseModel):
    shape: Shape
    dtype: NumberType


class _Input(_Numbers):
    name: str
    key: Annotated[list[str], Field(min_length=1)]


class _State(_Numbers):
    input: str
    output: str
    first: float | list[Any]

    @model_validator(mode="after")
    def _begins(self) -> _State:
        np.broadcast_to(np.asarray(self.first, float), self.shape)  # ValueError if it does not fit
        return self


class _Output(BaseModel):
    shape: Shape
    space: _Numbers
    choices: list[int] = []
    lowest: list[int] = []
    bounds: dict[str, Any] | None = None


class _Guide(BaseModel):
    place: Literal["absent", "inside", "outside"]
    names: list[str] = []
    reason: str = ""


class _Env(BaseModel):
    title: str


class _Contract(BaseModel):
    """The part of a contract that is read; further keys are ignored."""

    inputs: list[_Input]
    state: list[_State]
    outputs: Annotated[list[_Output], Field(min_length=1)]
    guide: _Guide
    env: _Env
