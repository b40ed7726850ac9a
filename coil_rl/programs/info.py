"""`coil-info`: the versions of a bug report, the command of a run, or what a policy means."""

import json
import shlex
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from coil_rl import record
from coil_rl.errors import UserError
from coil_rl.extras import require
from coil_rl.output import printable
from coil_rl.programs import app
from coil_rl.run.folder import is_begun, versions

HELP = """coil-info: the versions that a bug report needs, the command that made a run, or what an
exported policy says about itself.

  coil-info
  coil-info run=outputs/train/FOLDER
  coil-info run=exported/policy.onnx"""


def describe(folder: Path) -> dict[str, str]:
    """Return the command that made a run, and the versions that it was begun with.

    Raises:
        UserError: if there is no run, or a file about it is damaged.
    """
    if not is_begun(folder):
        raise UserError(f"run={folder} is not the folder of a run: it has no config.yaml")
    words = record.COMMAND.read(folder)
    unknown = "not known: the run was not made on a command line"
    return {"command": shlex.join(words) if words else unknown} | (
        record.VERSIONS.read(folder) or {}
    )


def explain(file: Path) -> dict[str, str]:
    """Return what an exported policy says about itself: its metadata, with each part of a contract.

    Raises:
        UserError: without onnxruntime, for a file that is none, or that says nothing.
    """
    require("run=FILE.onnx", "export", "onnxruntime")
    import onnxruntime

    try:
        session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        said = dict(session.get_modelmeta().custom_metadata_map)
        contract = json.loads(said.pop("contract", "{}"))
    except Exception as error:  # of many classes
        raise UserError(f"run={file} cannot be read as a file of ONNX: {error}") from error
    if not said and not contract:
        raise UserError(f"run={file} says nothing about itself; export it with coil-export run=RUN")
    return said | dict(_parts("", contract))


def _parts(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """Yield the parts of a contract that say anything, those of a list by their own names."""
    if isinstance(value, list) and any(isinstance(each, dict) for each in value):
        value = {str(each.get("name", index)): each for index, each in enumerate(value)}
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _parts(f"{name}.{key}".lstrip("."), part)
    elif value not in (None, [], ""):
        yield name, value if isinstance(value, str) else json.dumps(value)


def info(arguments: Sequence[str]) -> None:
    """Print one name and its value a line."""
    if not arguments:
        result = versions()
    elif len(arguments) == 1 and arguments[0].startswith("run="):
        path = Path(arguments[0].removeprefix("run=")).expanduser()
        result = explain(path) if path.suffix == ".onnx" else describe(path)
    else:
        raise UserError(f"{' '.join(arguments)}: coil-info takes nothing, or run=FOLDER")
    result = {printable(name): printable(value) for name, value in result.items()}
    width = max(map(len, result))
    for name, value in result.items():
        print(f"{name:{width}}  {value}")


main = partial(app.plain_program, "info", HELP, info)

if __name__ == "__main__":
    main()
