"""From a configuration to objects: the one place that wires the parts together and calls `instantiate`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import hydra.utils
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, EnvBase, RewardSum, Transform, TransformedEnv

from coil_rl.errors import UserError
from coil_rl.guides.simple import FollowAdvice
from coil_rl.signature import check_call, shown, takes
from coil_rl.transforms import GuideActions


def build(node: Any, name: str, kind: type | None = None, **given: Any) -> Any:
    """Instantiate a node of the configuration after checking it against what its target takes.

    Args:
        node: has a `_target_`; nodes inside it are instantiated too.
        name: what a person calls this node, for the message.
        kind: what it must make, if not just anything.
        given: arguments that do not come from the configuration.

    Raises:
        UserError: if the node has no `_target_`, if that does not exist, does not take a key or a value, or makes
            something else.
    """
    node = check_node(node, name, given)
    try:
        built = hydra.utils.instantiate(node, **given, _convert_="all")
    except hydra.errors.InstantiationException as error:
        cause = error.__cause__
        if isinstance(cause, (UserError, ValueError, KeyError, TypeError, OSError)):
            said = cause.args[0] if isinstance(cause, KeyError) and cause.args else cause
            raise UserError(f"{name}: {' '.join(str(said).split())}") from error
        if cause is None:  # Hydra itself will not call this target
            raise UserError(f"{name}: {' '.join(str(error).split())}") from error
        if isinstance(cause, MemoryError) or "allocate" in str(cause):
            raise UserError(f"{name}: there is not enough memory; make it smaller") from error
        raise
    if kind is not None and not isinstance(built, kind):
        raise UserError(f"{name}: {node['_target_']} makes {type(built).__name__}, but {kind.__name__} is wanted")
    return built


def check_node(node: Any, name: str, given: Iterable[str] = ()) -> dict[str, Any]:
    """The node with all references resolved, if it and the nodes inside it are calls that can be made.

    Args:
        node: as for `build`.
        name: as for `build`.
        given: the names of what `build` is given besides.

    Raises:
        UserError: as `build`, without building anything.
    """
    if isinstance(node, (DictConfig, ListConfig)):
        node = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    if not isinstance(node, Mapping) or "_target_" not in node:
        raise UserError(f"{name}={shown(node)} names nothing to build; give it a _target_, the full name of a class")
    _check(node, name, given)
    return dict(node)


def _check(node: Any, name: str, given: Iterable[str] = ()) -> None:
    if isinstance(node, Mapping):
        for key, value in node.items():
            _check(value, f"{name}.{key}")
        if "_target_" in node:
            check_call(_target(node["_target_"], name), node, name, given)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _check(value, f"{name}[{index}]")


def _target(target: Any, name: str) -> Callable[..., Any]:
    try:
        found = hydra.utils.get_object(target)
    except Exception as error:
        raise UserError(f"{name}: there is no {target!r}; is it spelt right, and its package installed?") from error
    if not callable(found):
        raise UserError(f"{name}: {target} is {found!r}, which cannot be called; give a class or a function")
    called: Callable[..., Any] = found
    return called


def build_env(config: DictConfig, overrides: Mapping[str, Any] | None = None, *, advice: str | None = None) -> EnvBase:
    """The env of a configuration as its agent sees it, which also adds up the task's reward as `episode_reward`.

    Args:
        config: with `env`, `method`, `degrade` and `action`.
        overrides: what to change in `env`.
        advice: which of `evaluation.advice` comes last, and degrades the advice once more.

    Raises:
        UserError: as `build`, and if the transforms do not fit together.
    """
    return as_its_agent_sees(config, build_bare_env(config, overrides), advice=advice)


def as_its_agent_sees(config: DictConfig, env: EnvBase, *, advice: str | None = None) -> EnvBase:
    """Any env with the transforms of a configuration around it.

    Args:
        config: with `method`, `degrade` and `action`.
        env: without transforms.
        advice: as for `build_env`.

    Raises:
        UserError: as `build`, and if the transforms do not fit together.
    """
    return _transformed(env, build_transforms(config, advice), "method.transforms")


def _transformed(env: EnvBase, transforms: Sequence[Transform], name: str) -> EnvBase:
    # The sum comes first, before a method changes what the agent is paid.
    env = TransformedEnv(env, Compose(RewardSum(), *transforms))
    try:
        env.observation_spec  # noqa: B018  transforms look at what stands before them once they are asked
    except (KeyError, ValueError) as error:
        raise UserError(f"{name}: {error.args[0]}") from error
    return env


def build_transforms(config: DictConfig, advice: str | None = None) -> list[Transform]:
    """The transforms of a method, those that degrade what its guides say, if it asks any, and what makes choices of it.

    Args:
        config: with `method`, `degrade` and `action`.
        advice: as in `build_env`.
    """
    transforms = build_all(config.method.transforms, "method.transforms")
    if transforms:
        transforms += build_all(config.degrade, "degrade")
    if advice:
        transforms.append(build(config.evaluation.advice[advice], f"evaluation.advice.{advice}", Transform))
    if config.action:
        transforms.append(build(config.action, "action", Transform))
    return transforms


def build_all(nodes: Mapping[str, Any], name: str) -> list[Transform]:
    """Transforms in the order in which they stand in the configuration."""
    return [build(node, f"{name}.{key}", Transform) for key, node in nodes.items()]


def build_guided_env(
    config: DictConfig, overrides: Mapping[str, Any], guides: Mapping[str, TensorDictModuleBase] | None = None
) -> tuple[EnvBase, TensorDictModuleBase]:
    """The env of a configuration, and a policy by which its guides drive there, degraded as the configuration says.

    Args:
        config: with `env`, `guide` and `degrade`.
        overrides: what to change in `env`, with `num_cars`. There are so many cars for each guide, the first guide's
            first.
        guides: others than those of the configuration.

    Raises:
        UserError: as `build_env`.
    """
    guides = guides or build_guides(config)
    cars = overrides["num_cars"]
    env = build_bare_env(config, {**overrides, "num_cars": cars * len(guides)})
    env = _transformed(env, [GuideActions(guides), *build_all(config.degrade, "degrade")], "degrade")
    return env, FollowAdvice(env, [guide for guide in range(len(guides)) for _ in range(cars)])


def build_bare_env(config: DictConfig, overrides: Mapping[str, Any] | None = None) -> EnvBase:
    """The env of a configuration without any transform; `overrides` as in `build_env`."""
    env: EnvBase = build(env_node(config, overrides), "env", EnvBase)
    return env


def env_node(config: DictConfig, overrides: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The node `env` of a configuration with all references resolved; `overrides` as in `build_env`."""
    with open_dict(config):  # which keys the env takes is its own to say
        node = OmegaConf.merge(config.env, dict(overrides or {}))
        for key, value in (overrides or {}).items():
            # What another target takes is not what the one before took.
            if isinstance(value, (Mapping, DictConfig)) and "_target_" in value:
                OmegaConf.update(node, key, value, merge=False)
    resolved: Any = OmegaConf.to_container(node, resolve=True)
    return dict(resolved)


def build_learner(config: DictConfig, env: EnvBase, guides: Mapping[str, TensorDictModuleBase] | None = None) -> Any:
    """The learner of a configuration, observing what its method and `also_observes` say of this env.

    Args:
        config: with `learner`, `method` and `also_observes`.
        env: as its agent sees it.
        guides: those that it trains, if it does.
    """
    given: dict[str, Any] = {"guides": dict(guides or {})} if trains_guides(config) else {}
    return build(config.learner, "learner", env=env, in_keys=[*config.method.observes, *config.also_observes], **given)


def trains_guides(config: DictConfig) -> bool:
    """Whether the learner of a configuration asks for guides, to improve them."""
    return learner_kind(config) == "guides"


def learner_kind(config: DictConfig) -> str:
    """What the learner of a configuration does, going by what it asks for.

    Returns:
        `guides` if it improves guides beside an agent, `imitation` if it asks where the advice is, to imitate it, or
        else `agent`.
    """
    asked = takes(_target(config.learner.get("_target_"), "learner"))
    return "guides" if "guides" in asked else "imitation" if "advice_key" in asked else "agent"


def build_guides(config: DictConfig) -> dict[str, TensorDictModuleBase]:
    """The guides of a configuration by name, in its order.

    Raises:
        UserError: as `build`, and if there is none, or one without a name.
    """
    if "_target_" in config.guide:
        raise UserError(
            "guide: a guide needs a name, so that others can stand beside it: let its file begin with "
            "# @package guide.NAME, or give +guide.NAME._target_"
        )
    if not config.guide:
        raise UserError("guide: there is none; give at least one, as in guide=spline")
    return {name: build(node, f"guide.{name}", TensorDictModuleBase) for name, node in config.guide.items()}
