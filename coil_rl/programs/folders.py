"""One spelling of a folder on the command line, with or without the quotes of Hydra.

Hydra reads `run=a=b` or `run=~/x` as a mistake and wants quotes, and `resume=` is read without
Hydra. Here the same text means the same folder in both: what the shell passes on is the name, and
the quotes of Hydra may be around it.
"""

from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from coil_rl.config.compose import quoted

# Keys that hold one folder or file; `folder` of coil-report may be a list of folders, too.
KEYS = (
    "run",
    "folder",
    "exported",
    "hydra.run.dir",
    "run_dir",
    "init",
    "guide.learned.run",
    "proxy.folder",
)
KEPT = ("init", "guide.learned.run")  # in the configuration of a run
FILE = ".file"  # the end of a key that holds a file, which is kept too


def spelled(argument: str) -> str:
    """Return an argument of a program as Hydra reads it: a folder has the quotes that it needs.

    One that the configuration of a run keeps is absolute.

    Args:
        argument: as the shell passed it on; it may be anything.
    """
    key, equals, text = argument.partition("=")
    name = key.lstrip("+")
    if not equals or not (name in KEYS or name.endswith(FILE)):
        return argument
    if not _exists(text) and _as_hydra(text) is not None:
        return argument
    path = _path(text)
    kept = name in KEPT or name.endswith(FILE)
    return f"{key}={quoted(str(path.absolute() if kept else path))}"


def folder(text: str) -> Path:
    """Return the folder that a text on the command line names.

    Args:
        text: its name, or the name in the quotes of Hydra.
    """
    if _exists(text):
        return _path(text)
    value = _as_hydra(text)
    return _path(value if isinstance(value, str) else text)


def _path(text: str) -> Path:
    try:
        return Path(text).expanduser()
    except RuntimeError:  # ~NAME without such a user
        return Path(text)


def _exists(text: str) -> bool:
    try:
        return bool(text) and _path(text).exists()
    except (OSError, ValueError):  # a name that is too long, or holds a zero
        return False


def _as_hydra(text: str) -> object | None:
    """Return the value that Hydra reads; None for what it cannot read, or would change."""
    if text.startswith("~"):
        return None
    try:
        override = OverridesParser.create().parse_override(f"run={text}")
    except HydraException:
        return None
    if override.is_sweep_override() or text == "null":
        return override
    return override.value()
