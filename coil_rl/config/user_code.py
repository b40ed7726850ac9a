"""Code of the user that a configuration names: classes and functions outside of this package."""

from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import hydra.utils
from omegaconf import DictConfig, OmegaConf

from coil_rl.config.fingerprint import fingerprint, is_of_user
from coil_rl.config.trust import import_paths


def code_of_user(config: DictConfig, keys: Iterable[str]) -> list[str]:
    """Return a fingerprint of each class and function of the user that a configuration names.

    Args:
        config: the configuration.
        keys: parts of it to look at, among them `env`, whose id may be registered with Gymnasium.
    """
    parts = OmegaConf.masked_copy(config, list(keys))
    named = [*map(_named, sorted(import_paths(parts))), _registered(config.env.get("id"))]
    return [fingerprint(each) for each in named if each is not None and is_of_user(each)]


def _named(path: str) -> Any:
    """Return what an import path names; None for nothing, which is refused where it is built.

    Args:
        path: written with points only.
    """
    with suppress(Exception):
        return hydra.utils.get_object(path)
    return None


def _registered(id: Any) -> Any:
    """Return what makes an env that is registered with Gymnasium; None for another one.

    Args:
        id: of the env; it may be anything.
    """
    if isinstance(id, str):
        with suppress(Exception):
            from coil_rl.foreign.makers import registered_maker

            return registered_maker(id)
    return None
