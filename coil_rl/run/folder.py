"""The folder of a run: its lock, configuration and software versions."""

import errno
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from coil_rl import record
from coil_rl.errors import RunningError, UserError
from coil_rl.files import remove_unfinished, write_text
from coil_rl.output import say
from coil_rl.plain_yaml import read_yaml, yaml_of

CONFIG = "config.yaml"
CODE, CODE_BEFORE = "code", "code_before"  # keys of it, see `code_of`
HANDED_OVER = "handed_over"  # the policy that `delivery` chose
ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (
    "coil-rl",
    "torch",
    "torchrl",
    "tensordict",
    "hydra-core",
    "gymnasium",
    "stable-baselines3",
    "numpy",
    "scipy",
    "matplotlib",
)


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Make a run folder and lock it until the block or this process ends.

    If another process holds the lock, raise a `RunningError`, or with `wait` wait for it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = folder / ".lock"
    if lock.is_dir():
        raise UserError(f"{lock} is a folder, but must be a file that locks the run; remove it")
    try:
        with FileLock(lock, timeout=-1 if wait else 0):
            remove_unfinished(folder)
            yield
    except Timeout:
        raise RunningError(
            f"another process is running in {folder}; wait until it ends, or end it"
        ) from None


def write_config(folder: Path, saved: Mapping[str, Any]) -> None:
    """Write the configuration of a run: plain values only."""
    write_text(folder / CONFIG, yaml_of(saved))


def code_of(folder: Path) -> dict[str, Any]:
    """Return what the configuration in a folder says about the code of the user.

    It is the SHA-256 of each file by its module (`CODE`), and what these were before changes that
    the user accepted (`CODE_BEFORE`). Folders of earlier versions say nothing.
    """
    saved = read_yaml(folder / CONFIG)
    return {key: saved[key] for key in (CODE, CODE_BEFORE) if isinstance(saved.get(key), Mapping)}


def changed_code(folder: Path, present: Mapping[str, str]) -> str:
    """Return the names of the modules whose file is another one than in a folder; empty for none.

    Args:
        present: SHA-256 of each file by its module.
    """
    begun = code_of(folder).get(CODE, present)
    names = [name for name in {**begun, **present} if begun.get(name) != present.get(name)]
    return " and ".join(sorted(names))


def weights_file(folder: Path, which: str = "last") -> Path:
    """Return the file with the weights of the `last` or the `handed_over` policy of a run."""
    return folder / f"policy_{which}.pt"


def check_same(
    saved: Mapping[str, Any], requested: Mapping[str, Any], holder: str, remedy: str
) -> None:
    """Raise a `UserError` if two configurations differ.

    The message begins with the holder of the first one. A part, such as the learner, is named
    before its values.
    """
    keys = dict.fromkeys([*saved, *requested])
    differ = [key for key in keys if saved.get(key) != requested.get(key)]
    if differ:
        key = max(differ, key=lambda key: key.endswith("_target_"))  # the first of equals
        raise UserError(f"{holder} with {key}={saved.get(key)}, not {requested.get(key)}; {remedy}")


def refuse_links(folder: Path) -> None:
    """Raise a `UserError` for a link through which a run could write outside of its folder."""
    inside = os.path.realpath(folder)
    for path in folder.rglob("*"):
        if not path.is_symlink() or Path(os.path.realpath(path)).is_relative_to(inside):
            continue
        # W&B leaves links to its logs in the folders of its earlier records, which are finished.
        parts = path.relative_to(folder).parts
        if parts[0] == "wandb" and len(parts) > 2:
            continue
        raise UserError(
            f"{path} is a link out of the folder of the run, so that it could write there; put the "
            "file in its place"
        )


def is_begun(folder: Path) -> bool:
    """Return whether a folder holds a run, finished or not."""
    try:
        return (folder / CONFIG).exists()
    except OSError as error:
        if error.errno != errno.ENAMETOOLONG:  # no folder can have this name
            raise
        return False


def is_evaluated(folder: Path) -> bool:
    """Return whether a run is finished: its evaluation is the last thing it writes."""
    return (folder / record.EVALUATION.name).exists()


def report_changed_versions(folder: Path) -> None:
    """Say on standard error if a run was begun with other versions.

    They are the versions of Python and of the packages.
    """
    try:
        begun = record.VERSIONS.read(folder) or {}
    except UserError:
        begun = {}
    present = versions()
    names = [name for name in ("python", *PACKAGES) if begun.get(name) != present[name]]
    if names:
        changes = ", ".join(
            f"{name} {begun.get(name, 'unknown')} (here {present[name]})" for name in names
        )
        say(
            f"{folder} was begun with {changes}; its numbers may differ from now on",
            error=True,
        )


def versions() -> dict[str, str]:
    """Return the versions of Python and important packages, the commit, and the machine."""
    result = {"python": platform.python_version(), "platform": platform.platform()}
    for name in PACKAGES:
        try:
            result[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            result[name] = "not installed"
    # Not of a repository around this one, such as that of a project with an environment inside.
    git = [
        "git",
        "-C",
        str(ROOT),
        "--git-dir=.git",
        "describe",
        "--always",
        "--dirty",
        "--abbrev=12",
    ]
    result["commit"] = _output(git) or "not a git checkout"
    result["cpus"] = str(os.cpu_count())
    result["gpu"] = (
        _output(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]) or "not available"
    )
    return result


def _output(command: list[str]) -> str:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
        return ", ".join(done.stdout.strip().splitlines())
    except (OSError, subprocess.SubprocessError):
        return ""
