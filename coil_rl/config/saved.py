"""The configuration in the folder of a run: written, read without running code, and compared."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.logger import shipped_logger
from coil_rl.config.measured import complete_measures, is_complete
from coil_rl.config.old_names import renamed, with_todays_keys
from coil_rl.config.schema import IGNORED_KEYS, TrainConfig
from coil_rl.config.sentences import sentence
from coil_rl.config.trust import check_config
from coil_rl.errors import UserError
from coil_rl.plain_yaml import read_yaml
from coil_rl.run.folder import CONFIG, check_same, is_begun


def settings(config: DictConfig) -> dict[str, Any]:
    """Return what is saved of a configuration: plain values, without references."""
    saved: Any = OmegaConf.to_container(config, resolve=True)
    saved.pop("trust", None)  # it holds for one command
    # Loggers write into `run_dir`, which may be another folder when the run is resumed.
    saved["logger"] = OmegaConf.to_container(config.logger) if config.logger else None
    return dict(saved)


def read_config(
    folder: Path,
    key: str,
    changes: Mapping[str, Any] | None = None,
    *,
    goes_on: bool = False,
) -> DictConfig:
    """Return the configuration of the run in a folder.

    The folder may come from anybody; `trust_packages` names packages that it may use.

    Args:
        folder: of the run.
        key: of the calling program that names the folder, for the message.
        changes: new values of top-level keys.
        goes_on: whether the run may be trained further, so that its logger is needed. A shipped one
            is taken by its name, see `coil_rl.config.logger`; another one must be trusted as any
            part, and is left out where the run is only evaluated.

    Raises:
        UserError: for a configuration that cannot be read, could run code, or is of a run that was
            made from parts.
    """
    path = folder / CONFIG
    if not (is_begun(folder) and path.is_file()):
        raise UserError(f"{key}={folder} is not the folder of a run: it has no config.yaml")
    try:
        values = read_yaml(path)
        if values is None:
            raise UserError(f"{path} is not the configuration of a run (it is empty)")
        if not isinstance(values, dict):
            raise UserError(f"{path} is not the configuration of a run, but a list")
        if values.get("made_from_parts"):
            raise UserError(
                f"{key}={folder} was made in Python from parts, which no file names; "
                "make the same coil_rl.Run there, and call its methods"
            )
        logger = shipped_logger(values.get("logger"))
        if logger is not None or not goes_on:
            values["logger"] = None
        saved = OmegaConf.create(renamed(with_todays_keys(values), path))
        check_config(saved, path)
        if logger is not None:
            saved["logger"] = logger
        for name, value in (changes or {}).items():
            saved[name] = value
        config: Any = OmegaConf.merge(OmegaConf.structured(TrainConfig), saved)
        complete_measures(config)
        OmegaConf.to_container(config, throw_on_missing=True)
    except (OmegaConfBaseException, yaml.YAMLError, ValueError, OSError) as error:
        raise UserError(f"{path} is not the configuration of a run ({sentence(error)})") from error
    return config


def holds(folder: Path, config: DictConfig) -> bool:
    """Return whether a folder holds a run; a `UserError` if that has another configuration."""
    if not is_begun(folder):
        return False
    saved = read_config(folder, "run_dir")
    remedy = "choose another folder, or remove that one"
    check_same(identity(saved), identity(config), f"{folder} holds a run", remedy)
    return True


def identity(config: DictConfig) -> dict[str, Any]:
    """Return the values on which the numbers of a run depend, by their full keys.

    Args:
        config: composed, or read from a folder; it stays as it is.
    """
    measures: Any = OmegaConf.select(config, "evaluation.measures")
    if not all(is_complete(measures, name) for name in measures or ()):
        config = copy.deepcopy(config)  # which takes longer than all else here
        complete_measures(config)
    values: Any = OmegaConf.to_container(config, resolve=True)
    if values.get("recording") is None:  # of all envs but one
        values.pop("recording", None)
    flat = _flat(values)
    ignored = set(IGNORED_KEYS)
    return {
        key: value
        for key, value in flat.items()
        if key not in ignored and key.split(".")[0] not in ignored
    }


def _flat(node: Any, name: str = "") -> dict[str, Any]:
    """Return the values of nested mappings by their full keys."""
    if not isinstance(node, Mapping) or not node:
        return {name: node}
    result: dict[str, Any] = {}
    for key, value in node.items():
        result |= _flat(value, f"{name}.{key}" if name else str(key))
    return result
