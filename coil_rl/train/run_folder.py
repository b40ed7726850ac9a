"""The folder of a run: who may write there, and the configuration that it keeps."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf

from coil_rl.errors import UserError
from coil_rl.files import remove_unfinished, whole_file, write_text
from coil_rl.train.fingerprint import IGNORED_KEYS
from coil_rl.train.load import read_config
from coil_rl.train.versions import versions


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Keep every other process from writing a run there until the block ends, or this process does.

    Args:
        folder: of the run; it is made.
        wait: for a process that has locked it, instead of refusing.

    Raises:
        UserError: if another process has locked the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=-1 if wait else 0):
            remove_unfinished(folder)
            yield
    except Timeout:
        raise UserError(f"another process is running in {folder}; wait until it ends, or end it") from None


def begin(config: DictConfig, folder: Path) -> None:
    """Keep the configuration and the versions of a new run; from then on the folder holds one.

    Raises:
        UserError: if it already does.
    """
    if (folder / "config.yaml").exists():
        raise UserError(
            f"{folder} already holds a run; go on with it by coil-train resume={folder}, "
            "or choose another folder with hydra.run.dir=FOLDER"
        )
    write_text(folder / "versions.json", json.dumps(versions(), indent=2))
    kept = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    # A logger writes into `run_dir`, wherever that is when the run goes on.
    kept.logger = OmegaConf.to_container(config.logger) if config.logger else None
    with whole_file(folder / "config.yaml") as unfinished:
        OmegaConf.save(kept, unfinished)


def holds(folder: Path, config: DictConfig) -> bool:
    """Whether the folder holds a run of just this configuration.

    Raises:
        UserError: if it holds one of another, naming the first value that is different.
    """
    if not (folder / "config.yaml").exists():
        return False
    kept, wanted = (
        _flat(OmegaConf.to_container(each, resolve=True)) for each in (read_config(folder, "run_dir"), config)
    )
    for key in dict.fromkeys([*kept, *wanted]):
        if kept.get(key) != wanted.get(key) and key.split(".")[0] not in IGNORED_KEYS:
            raise UserError(
                f"{folder} holds a run with {key}={kept.get(key)}, not {wanted.get(key)}; "
                "choose another folder, or remove that one"
            )
    return True


def _flat(node: Any, name: str = "") -> dict[str, Any]:
    """The values of a configuration by their full names."""
    if not isinstance(node, Mapping) or not node:
        return {name: node}
    return {key: value for k, v in node.items() for key, value in _flat(v, f"{name}.{k}" if name else str(k)).items()}
