"""The folder of a run: its lock, configuration and software versions."""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.errors import UserError, sentence
from coil_rl.files import remove_unfinished, whole_file, write_text
from coil_rl.train.config import IGNORED_KEYS, TrainConfig
from coil_rl.train.trust import check_config, read_yaml

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

    If another process holds the lock, raise a `UserError`, or with `wait` wait for it.
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
        raise UserError(
            f"another process is running in {folder}; wait until it ends, or end it"
        ) from None


def begin(config: DictConfig, folder: Path) -> None:
    """Write the versions and the configuration of a new run; raise a `UserError` if there is a run already."""
    if (folder / "config.yaml").exists():
        remedy = f"resume it with coil-train resume={folder}, or choose another folder with hydra.run.dir=FOLDER"
        raise UserError(f"{folder} already holds a run; {remedy}")
    write_text(folder / "versions.json", json.dumps(versions(), indent=2))
    saved: Any = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    saved.pop("trust", None)  # it holds for one command
    # Loggers write into `run_dir`, which may be another folder when the run is resumed.
    saved.logger = OmegaConf.to_container(config.logger) if config.logger else None
    with whole_file(folder / "config.yaml") as unfinished:
        OmegaConf.save(saved, unfinished)


def read_config(folder: Path, key: str, changes: Mapping[str, Any] | None = None) -> DictConfig:
    """Return the configuration of the run in a folder, with `changes`, new values of top-level keys.

    `key` is the key of the calling program that names the folder, for the message. The folder may
    come from anybody: a configuration that cannot be read or could run code is a `UserError`;
    `trust_packages` names packages it may use.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        raise UserError(f"{key}={folder} is not the folder of a run: it has no config.yaml")
    try:
        saved = read_yaml(path)
        if not isinstance(saved, DictConfig):
            raise UserError(f"{path} is not the configuration of a run, but a list")
        check_config(saved, path)
        for name, value in (changes or {}).items():
            saved[name] = value
        config: Any = OmegaConf.merge(OmegaConf.structured(TrainConfig), saved)
        OmegaConf.to_container(config, throw_on_missing=True)
    except (OmegaConfBaseException, yaml.YAMLError, ValueError, OSError) as error:
        raise UserError(f"{path} is not the configuration of a run ({sentence(error)})") from error
    return config


def holds(folder: Path, config: DictConfig) -> bool:
    """Return whether the folder holds a run; raise a `UserError` if that has another configuration."""
    if not (folder / "config.yaml").exists():
        return False
    saved, remedy = read_config(folder, "run_dir"), "choose another folder, or remove that one"
    check_same(flat(saved), flat(config), f"{folder} holds a run", remedy)
    return True


def check_same(
    saved: Mapping[str, Any], requested: Mapping[str, Any], holder: str, remedy: str
) -> None:
    """Raise a `UserError` if two results of `flat` differ; the message begins with the holder of the first one."""
    for key in dict.fromkeys([*saved, *requested]):
        if saved.get(key) != requested.get(key):
            raise UserError(
                f"{holder} with {key}={saved.get(key)}, not {requested.get(key)}; {remedy}"
            )


def flat(config: DictConfig) -> dict[str, Any]:
    """Return the values on which the numbers of a run depend, by their full keys."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    return {
        key: value
        for key, value in _flat(values).items()
        if not {key, key.split(".")[0]} & {*IGNORED_KEYS}
    }


def _flat(node: Any, name: str = "") -> dict[str, Any]:
    """Return the values of a configuration by their full keys."""
    if not isinstance(node, Mapping) or not node:
        return {name: node}
    return {
        key: value
        for k, v in node.items()
        for key, value in _flat(v, f"{name}.{k}" if name else str(k)).items()
    }


def is_evaluated(folder: Path) -> bool:
    """Return whether a run is finished: its evaluation is the last thing it writes."""
    return (folder / "evaluation.csv").exists()


def report_changed_versions(folder: Path) -> None:
    """Print one line on standard error if a run was begun with other versions of Python or of the packages."""
    try:
        begun = dict(json.loads((folder / "versions.json").read_text()))
    except (OSError, TypeError, ValueError):
        begun = {}
    present = versions()
    names = [name for name in ("python", *PACKAGES) if begun.get(name) != present[name]]
    if names:
        changes = ", ".join(
            f"{name} {begun.get(name, 'unknown')} (here {present[name]})" for name in names
        )
        print(
            f"{folder} was begun with {changes}; its numbers may differ from now on",
            file=sys.stderr,
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
