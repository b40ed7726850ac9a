"""The folder of a run: who may write there, and the configuration that it keeps."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config import Train
from coil_rl.errors import UserError
from coil_rl.files import remove_unfinished, whole_file
from coil_rl.programs.sentence import sentence
from coil_rl.programs.versions import versions


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Keep every other process from writing a run there until the block ends, or this process does.

    Raises:
        UserError: if another process has claimed the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".lock", timeout=0):
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
    with whole_file(folder / "versions.json") as unfinished:
        unfinished.write_text(json.dumps(versions(), indent=2) + "\n")
    kept = OmegaConf.create(OmegaConf.to_container(config, resolve=True))
    # A logger writes into `run_dir`, wherever that is when the run goes on.
    kept.logger = OmegaConf.to_container(config.logger) if config.logger else None
    with whole_file(folder / "config.yaml") as unfinished:
        OmegaConf.save(kept, unfinished)


def configuration(folder: Path, key: str, instead: Mapping[str, Any] | None = None) -> DictConfig:
    """The configuration of the run in a folder.

    Args:
        folder: of the run.
        key: by which a person named it, for the message.
        instead: top-level keys that get other values.

    Raises:
        UserError: if the folder holds no run, or a configuration that cannot be read.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        raise UserError(f"{key}={folder} is not the folder of a run: it has no config.yaml")
    try:
        kept = OmegaConf.load(path)
        if not isinstance(kept, DictConfig):
            raise UserError(f"{path} is not the configuration of a run, but a list")
        for name, value in (instead or {}).items():
            kept[name] = value
        config: Any = OmegaConf.merge(OmegaConf.structured(Train), kept)
        OmegaConf.to_container(config, throw_on_missing=True)
    except (OmegaConfBaseException, yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise UserError(f"{path} is not the configuration of a run ({sentence(error)})") from error
    return config
