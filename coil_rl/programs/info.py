"""`coil-info`: print the versions that a bug report needs, or the command that made a run."""

import json
import sys
from pathlib import Path

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.programs import app
from coil_rl.run.folder import COMMAND, is_begun, versions

HELP = """coil-info: the versions that a bug report needs, or the command that made a run.

  coil-info
  coil-info run=outputs/train/FOLDER"""


def describe(folder: Path) -> dict[str, str]:
    """Return the command that made a run, and the versions that it was begun with.

    Args:
        folder: of the run.

    Raises:
        UserError: if there is no run, or a file about it is damaged.
    """
    if not is_begun(folder):
        raise UserError(f"run={folder} is not the folder of a run: it has no config.yaml")
    command = folder / COMMAND
    made = "not known: the run was not made on a command line"
    if command.exists():
        with file_of_a_run(command, "remove it"):
            made = command.read_text(encoding="utf-8").strip()
    file = folder / "versions.json"
    begun = {}
    if file.exists():
        with file_of_a_run(file, "remove it"):
            begun = {str(name): str(value) for name, value in json.loads(file.read_text()).items()}
    return {"command": made, **begun}


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
            print(f"{name:{width}}  {value}")


if __name__ == "__main__":
    main()
