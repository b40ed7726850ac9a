"""`coil-info`: print the versions that a bug report needs, or the command that made a run."""

import shlex
import sys
from pathlib import Path

from coil_rl import record
from coil_rl.errors import UserError
from coil_rl.programs import app
from coil_rl.run.folder import is_begun, versions

HELP = """coil-info: the versions that a bug report needs, or the command that made a run.

  coil-info
  coil-info run=outputs/train/FOLDER"""


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


def printable(text: str) -> str:
    """Return a text of a file, which may be somebody else's, without what a terminal obeys."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def main() -> None:
    """Print one name and its value a line."""
    arguments = sys.argv[1:]
    if arguments in (["--help"], ["-h"]):
        print(HELP)
        return
    with app.program("info"):
        if not arguments:
            result = versions()
        elif len(arguments) == 1 and arguments[0].startswith("run="):
            result = describe(Path(arguments[0].removeprefix("run=")).expanduser())
        else:
            raise UserError(f"{' '.join(arguments)}: coil-info takes nothing, or run=FOLDER")
        width = max(map(len, result))
        for name, value in result.items():
            print(f"{name:{width}}  {printable(value)}")


if __name__ == "__main__":
    main()
