"""What a run left behind: its configuration and its policy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.errors import UserError
from coil_rl.sentence import sentence
from coil_rl.train import checkpoint
from coil_rl.train.build import as_its_agent_sees, build_env, build_guides, build_learner, trains_guides
from coil_rl.train.config import Train

PROXIES = "proxies"  # where a run keeps networks that stand for its guides


def read_config(folder: Path, key: str, instead: Mapping[str, Any] | None = None) -> DictConfig:
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


def load_policy(folder: Path, config: DictConfig, env: EnvBase, which: str = "last") -> TensorDictModuleBase:
    """The policy of the run in a folder.

    Args:
        folder: of the run.
        config: its configuration.
        env: as its agent sees it.
        which: last, or best: with the highest mean return of a training batch.

    Raises:
        UserError: if it has no such policy, or one that does not fit.
    """
    learner = build_learner(config, env, load_guides(folder, config) if trains_guides(config) else None)
    path = weights_file(folder, which)
    try:
        learner.policy.load_state_dict(checkpoint.load(path, config.device))
    except (RuntimeError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path} does not fit the networks that {folder / 'config.yaml'} describes; give the folder as it was"
        ) from error
    restored: TensorDictModuleBase = learner.policy
    return restored


def weights_file(folder: Path, which: str = "last") -> Path:
    """The file in which a run keeps its policy; `which` as in `policy`."""
    return folder / f"policy_{which}.pt"


def load_policy_in_env(
    folder: Path, config: DictConfig, env: EnvBase, which: str = "last"
) -> tuple[EnvBase, TensorDictModuleBase]:
    """The policy of the run in a folder, and around an env what it needs to act there: its guides and transforms.

    What reaches the env is what had reached the one it was trained in: a residual policy adds to its guide's action.

    Args:
        folder: of the run.
        config: its configuration; its own `env` and tracks are not built.
        env: without transforms, of any batch size.
        which: as in `policy`.

    Raises:
        UserError: as `policy`; if the run has no agent, or its agent cannot act in this env.
    """
    if config.method.observes is None:
        raise UserError(f"{folder} has no agent: its guide drives alone; name that guide instead")
    try:
        seen = as_its_agent_sees(config, env)
        return seen, load_policy(folder, config, seen, which)
    except UserError as error:
        raise UserError(f"run {folder}: {error}") from error


def load_guides(folder: Path, config: DictConfig) -> dict[str, TensorDictModuleBase]:
    """The guides of a run that trains them, as they were before: where it has a proxy of one, that.

    Args:
        folder: of the run.
        config: its configuration.

    Raises:
        UserError: if a proxy cannot be used.
    """
    found = build_guides(config)
    for name in found:
        proxy = folder / PROXIES / name
        if proxy.exists():
            of_proxy = read_config(proxy, f"the proxy of guide.{name}", {"device": config.device})
            found[name] = load_policy(proxy, of_proxy, build_env(of_proxy))
    return found
