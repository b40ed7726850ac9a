"""From a configuration to objects: the one place that wires the parts together and calls `instantiate`."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import hydra.utils
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, EnvBase, RewardSum, TransformedEnv

from coil_rl.errors import UserError


def build(node: Any, name: str, **given: Any) -> Any:
    """Instantiate a node of the configuration after checking its keys against what its target takes.

    Args:
        node: has a `_target_`; nodes inside it are instantiated too.
        name: what a person calls this node, for the message.
        given: arguments that do not come from the configuration.

    Raises:
        UserError: if a key is none of the target's, if the target does not exist, or if it refuses a value.
    """
    if isinstance(node, DictConfig):
        node = OmegaConf.to_container(node, resolve=True)
    _check(node, name, set(given))
    try:
        return hydra.utils.instantiate(node, **given, _convert_="all")
    except hydra.errors.InstantiationException as error:
        if isinstance(error.__cause__, (ValueError, KeyError, TypeError)):
            raise UserError(f"{name}: {error.__cause__.args[0]}") from error
        raise


def _check(node: Any, name: str, given: set[str]) -> None:
    if isinstance(node, Mapping):
        if "_target_" in node:
            target = node["_target_"]
            try:
                called = hydra.utils.get_object(target)
            except Exception as error:
                raise UserError(f"{name}: there is no {target}; is its package installed?") from error
            _check_keys(called, set(node) - {"_target_", "_partial_"} | given, name, target)
        for key, value in node.items():
            _check(value, f"{name}.{key}", set())
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _check(value, f"{name}[{index}]", set())


def _check_keys(called: Any, keys: set[str], name: str, target: str) -> None:
    parameters = inspect.signature(called).parameters.values()
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    takes = [parameter.name for parameter in parameters if parameter.kind is not parameter.VAR_POSITIONAL]
    unknown = sorted(keys - set(takes))
    if unknown:
        raise UserError(f"{name}: {target.rsplit('.')[-1]} takes no {', '.join(unknown)}; it takes {', '.join(takes)}")


def build_env(config: DictConfig, overrides: Mapping[str, Any] | None = None, *, observed: bool = True) -> EnvBase:
    """The env of a configuration, inside the transforms of its method, which adds up `episode_reward`.

    Args:
        config: with `env` and `method`.
        overrides: what to change in `env`.
        observed: False leaves the method's transforms out: a guide drives in the bare env.
    """
    node = OmegaConf.merge(config.env, dict(overrides or {}))
    env: EnvBase = build(node, "env")
    parts = config.method.transforms if observed else []
    transforms = [build(part, f"method.transforms[{i}]") for i, part in enumerate(parts)]
    return TransformedEnv(env, Compose(*transforms, RewardSum()))


def build_guide(config: DictConfig) -> TensorDictModuleBase:
    """The guide of a configuration."""
    guide: TensorDictModuleBase = build(config.guide, "guide")
    return guide
