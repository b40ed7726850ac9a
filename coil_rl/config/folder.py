"""The configuration in the folder of a run: written, read without running code, and compared.

The folder may be that of a shipped policy: a finished run that is a part of the package, and is
opened by its name. Wherever a program takes the folder of a run to read, `pretrained:NAME` names
one. Its files are checked by their SHA-256 before any of them is read.
"""

import errno
import hashlib
import json
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.messages import sentence
from coil_rl.config.schema import IGNORED_KEYS, TrainConfig
from coil_rl.config.trust import check_config, shipped_logger
from coil_rl.errors import UserError, did_you_mean
from coil_rl.files import LARGEST_NUMBERS, read_file, read_text
from coil_rl.measures import measures_of
from coil_rl.plain_yaml import is_part, leaves, read_yaml
from coil_rl.run.folder import CODE, CODE_BEFORE, CONFIG, check_same, is_begun

PREFIX = "pretrained:"
CHECKSUMS, CARD = "checksums.json", "card.md"
LARGEST = 200_000  # bytes of a file of a shipped policy
# Parts that moved, by the names that older run folders have for them.
OLD_NAMES = {
    "coil_rl.config.given.kept": "coil_rl.config.nodes.kept",
    "coil_rl.envs.EnvBatch": "coil_rl.foreign.torchrl_env.EnvBatch",
    "coil_rl.envs.gymnasium_env.GymnasiumEnv": "coil_rl.foreign.gymnasium_env.GymnasiumEnv",
    "coil_rl.guides.RecordingGuide": "coil_robot.RecordingGuide",
    "coil_rl.guides.cone_planner.ConePlannerGuide": "coil_rl.cones.ConePlannerGuide",
    "coil_rl.guides.learned.LearnedGuide": "coil_rl.LearnedGuide",
    "coil_rl.learners.Advisor": "coil_studies.Advisor",
    "coil_rl.learners.IBRL": "coil_studies.IBRL",
    "coil_rl.listening.TrackSections": "coil_studies.listening.TrackSections",
    "coil_rl.listening.WholeEpisode": "coil_studies.listening.WholeEpisode",
    "coil_rl.robot.classifier.load_classifier": "coil_robot.load_classifier",
    "coil_rl.run.tuning.Search": "coil_rl.tune.Tuning",
}


def settings(config: DictConfig) -> dict[str, Any]:
    """Return what is saved of a configuration: plain values, without references."""
    saved = _values(config)
    saved.pop("trust", None)  # it holds for one command
    # Loggers write into `run_dir`, which may be another folder when the run is resumed.
    saved["logger"] = OmegaConf.to_container(config.logger) if config.logger else None
    return saved


def read_config(
    folder: Path,
    key: str,
    changes: Mapping[str, Any] | None = None,
    *,
    goes_on: bool = False,
) -> DictConfig:
    """Return the configuration of the run in a folder.

    The folder may come from anybody; `trust_packages` names packages that it may use. What the run
    writes when it goes on is written there.

    Args:
        key: of the calling program that names the folder, for the message.
        goes_on: whether the run may be trained further, so that its logger is needed. A shipped one
            is taken by its name, see `coil_rl.config.trust`; another one must be trusted as any
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
        if not isinstance(values, dict):
            raise UserError(f"{path} is not the configuration of a run (it holds no keys)")
        if values.get("made_from_parts"):
            raise UserError(
                f"{key}={folder} was made in Python from parts, which no file names; "
                "make the same coil_rl.Run there, and call its methods"
            )
        values = {key: value for key, value in values.items() if key not in (CODE, CODE_BEFORE)}
        logger = shipped_logger(values.get("logger"))
        if logger is not None or not goes_on:
            values["logger"] = None
        saved = OmegaConf.create(renamed(values))
        check_config(saved, path)
        if logger is not None:
            saved["logger"] = logger
        for name, value in (changes or {}).items():
            saved[name] = value
        config: Any = OmegaConf.merge(OmegaConf.structured(TrainConfig), saved)
        # Not the folders that the file names.
        config.run_dir = str(folder.absolute())
        if config.proxy:
            config.proxy.folder = str(folder.absolute() / "distilled")
        measures_of(config.evaluation.measures)
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
    values = _values(config)
    if values.get("recording") is None:  # of all envs but one
        values.pop("recording", None)
    return {key: value for key, value in leaves(values).items() if not is_part(key, IGNORED_KEYS)}


def _values(config: DictConfig) -> dict[str, Any]:
    """Return the plain values of a configuration; its measures have all of theirs."""
    values: Any = OmegaConf.to_container(config, resolve=True)
    measures = measures_of(values["evaluation"]["measures"])
    values["evaluation"]["measures"] = {name: each.node() for name, each in measures.items()}
    return dict(values)


def make_folder(folder: Path) -> None:
    """Make the folder of a run, or raise a `UserError` if nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(errno.EACCES, "Permission denied", str(folder))
    except OSError as error:
        raise UserError(sentence(error)) from error


def pretrained_names() -> list[str]:
    """Return the names of the shipped policies."""
    return sorted(_checksums())


def pretrained_card(name: str) -> str:
    """Return the card of a shipped policy: what it was trained for, and how well it does.

    Args:
        name: of the policy.

    Raises:
        UserError: for a name that does not exist, and for files that are not those that were
            shipped.
    """
    return read_text(folder_of(name) / CARD, LARGEST)


def run_folder(text: str | Path) -> Path:
    """Return the folder that a text names: that of a shipped policy for `pretrained:NAME`.

    Raises:
        UserError: for a name that does not exist, and for files that are not those that were
            shipped.
    """
    if str(text).startswith(PREFIX):
        return folder_of(str(text).removeprefix(PREFIX))
    return Path(text).expanduser().absolute()


def folder_of(name: str) -> Path:
    """Return the folder of a shipped policy, whose files have been checked.

    Raises:
        UserError: for a name that does not exist, and for files that are not those that were
            shipped.
    """
    known = _checksums()
    if name not in known:
        raise UserError(
            f"{PREFIX}{name} does not exist; there are {', '.join(sorted(known))}"
            f"{did_you_mean(name, known)}"
        )
    folder = _place() / name
    for file, digest in known[name].items():
        path = folder / file
        content = read_file(path, LARGEST) if path.is_file() else b""
        if hashlib.sha256(content).hexdigest() != digest:
            raise UserError(
                f"{path} is not the file that was shipped: its SHA-256 is not {digest}; install "
                "coil-rl again"
            )
    return folder


def _place() -> Path:
    return Path(str(resources.files("coil_rl.policies")))


def _checksums() -> Mapping[str, Mapping[str, str]]:
    """Return the SHA-256 of each file by policy."""
    found: Mapping[str, Mapping[str, str]] = json.loads(
        read_text(_place() / CHECKSUMS, LARGEST_NUMBERS)
    )
    return found


def renamed(node: Any) -> Any:
    """Return nested values of a configuration with today's names of parts that moved."""
    if isinstance(node, Mapping):
        return {key: renamed(value) for key, value in node.items()}
    if isinstance(node, list):
        return [renamed(value) for value in node]
    return OLD_NAMES.get(node, node) if isinstance(node, str) else node
