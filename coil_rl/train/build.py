"""Construction of the env, the guides and the learner of a configuration; the only caller of `instantiate`."""

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import hydra.utils
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import Compose, EnvBase, RewardSum, Transform, TransformedEnv

from coil_rl.compiled import Compiled
from coil_rl.errors import UserError
from coil_rl.guides.simple import FollowAdvice
from coil_rl.learners.learner import Learner
from coil_rl.train.arguments import check_arguments, yaml_text
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import nested_key


def build(node: Any, name: str, expected: type | None = None, **arguments: Any) -> Any:
    """Instantiate a node of the configuration, and the nodes inside it, after a check of its arguments.

    A target that does not exist, refuses an argument, or returns another type is a `UserError`.

    Args:
        node: with a `_target_`.
        name: key of the node, for the message.
        expected: type of the result.
        arguments: added by the program.
    """
    node = check_node(node, name, arguments)
    try:
        built = hydra.utils.instantiate(node, **arguments, _convert_="all")
    except hydra.errors.InstantiationException as error:
        cause = error.__cause__
        if isinstance(cause, (UserError, ValueError, KeyError, TypeError, AttributeError, OSError)):
            message = cause.args[0] if isinstance(cause, KeyError) and cause.args else cause
            raise UserError(
                f"{name}: {textwrap.shorten(str(message), 500, placeholder=' ...')}"
            ) from error
        if isinstance(cause, ImportError):
            raise UserError(
                f"{name}: {node['_target_']} needs a package ({cause}); install it"
            ) from error
        if cause is None:  # Hydra itself refuses to call the target
            raise UserError(f"{name}: {error}") from error
        if isinstance(cause, MemoryError) or "allocate" in str(cause):
            raise UserError(f"{name}: there is not enough memory; make it smaller") from error
        raise
    if expected is not None and not isinstance(built, expected):
        raise UserError(
            f"{name}: {node['_target_']} makes {type(built).__name__}, not {expected.__name__}"
        )
    return built


def check_node(node: Any, name: str, program: Iterable[str] = ()) -> dict[str, Any]:
    """Return a node with its references resolved after the checks of `build`, without building anything.

    `program` has the names of the arguments that the program adds.
    """
    if isinstance(node, (DictConfig, ListConfig)):
        node = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    if not isinstance(node, Mapping) or "_target_" not in node:
        raise UserError(
            f"{name}={yaml_text(node)} has no _target_; give it one, the full name of a class or function"
        )
    _check(node, name, program)
    return dict(node)


def _check(node: Any, name: str, program: Iterable[str] = ()) -> None:
    if isinstance(node, Mapping):
        for key, value in node.items():
            _check(value, f"{name}.{key}")
        if "_target_" in node:
            check_arguments(_target(node["_target_"], name), node, name, program)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _check(value, f"{name}[{index}]")


def _target(path: Any, name: str) -> Callable[..., Any]:
    try:
        target: Callable[..., Any] = hydra.utils.get_object(path)
    except Exception as error:
        raise UserError(
            f"{name}: there is no {path!r}; check the spelling, and that its package is installed"
        ) from error
    if not callable(target):
        raise UserError(
            f"{name}: {path} is {target!r}, which cannot be called; give a class or a function"
        )
    return target


def build_env(
    config: DictConfig, overrides: Mapping[str, Any] | None = None, *, advice: str | None = None
) -> EnvBase:
    """Return the env of a configuration with all transforms; it also writes the sum of rewards, `episode_reward`.

    `overrides` are of `env`; `advice` is the key in `evaluation.advice` of one more transform of
    the advice. Errors are those of `build`; transforms that do not fit together are a `UserError`
    too.
    """
    return add_transforms(config, build_bare_env(config, overrides), advice=advice)


def compile_steps(config: DictConfig, env: EnvBase) -> EnvBase:
    """Return an env whose steps, and those of its guides, are compiled where they can be, if `compile` is true."""
    for module in env.modules() if config.compile else ():
        getattr(module, "compile_steps", lambda _: None)(Compiled)
    return env


def add_transforms(config: DictConfig, env: EnvBase, *, advice: str | None = None) -> EnvBase:
    """Return an env with the transforms of a configuration; arguments and errors as in `build_env`."""
    return _transformed(env, build_transforms(config, advice), "method.transforms")


def _transformed(env: EnvBase, transforms: Sequence[Transform], name: str) -> EnvBase:
    # The sum comes first, before a method changes the reward.
    env = TransformedEnv(env, Compose(RewardSum(), *transforms))
    try:
        env.observation_spec  # noqa: B018  transforms check the specs when these are computed
    except (KeyError, ValueError) as error:
        raise UserError(f"{name}: {error.args[0]}") from error
    return env


def build_transforms(config: DictConfig, advice: str | None = None) -> list[Transform]:
    """Return the transforms of method, `degrade` if the method has any, `advice`, `action` and network."""
    transforms = build_all(config.method.transforms, "method.transforms")
    if transforms:
        transforms += build_all(config.degrade, "degrade")
    if advice:
        transforms.append(
            build(config.evaluation.advice[advice], f"evaluation.advice.{advice}", Transform)
        )
    if config.action:
        transforms.append(build(config.action, "action", Transform))
    if network := OmegaConf.select(
        config, "learner.network"
    ):  # one with a memory needs an env that carries it
        transforms += getattr(build(network, "learner.network"), "env_transforms", list)()
    return transforms


def build_all(nodes: Mapping[str, Any], name: str) -> list[Transform]:
    """Return transforms in the order of the configuration."""
    return [build(node, f"{name}.{key}", Transform) for key, node in nodes.items()]


def build_guided_env(
    config: DictConfig,
    overrides: Mapping[str, Any],
    guides: Mapping[str, TensorDictModuleBase] | None = None,
) -> tuple[EnvBase, TensorDictModuleBase]:
    """Return the env of a configuration, and a policy that follows its guides, with degraded advice.

    Args:
        config: with `env`, `guide` and `degrade`.
        overrides: of `env`, with `num_envs`: the number of rows for each guide. Those of the first
            guide come first.
        guides: instead of those of the configuration.
    """
    guides = guides or build_guides(config)
    count = overrides["num_envs"]
    env = build_bare_env(config, {**overrides, "num_envs": count * len(guides)})
    env = _transformed(
        env, [GuideActions(guides), *build_all(config.degrade, "degrade")], "degrade"
    )
    return env, FollowAdvice(env, [guide for guide in range(len(guides)) for _ in range(count)])


def build_bare_env(config: DictConfig, overrides: Mapping[str, Any] | None = None) -> EnvBase:
    """Return the env of a configuration without transforms."""
    env: EnvBase = build(env_node(config, overrides), "env", EnvBase)
    return env


def env_node(config: DictConfig, overrides: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the node `env` with overrides and all references resolved."""
    with open_dict(config):  # `build` checks the keys
        node = OmegaConf.merge(config.env, dict(overrides or {}))
        for key, value in (overrides or {}).items():
            # The arguments of another target replace those of the first one.
            if isinstance(value, (Mapping, DictConfig)) and "_target_" in value:
                OmegaConf.update(node, key, value, merge=False)
    resolved: Any = OmegaConf.to_container(node, resolve=True)
    return dict(resolved)


def cases_node(
    config: DictConfig, cases: str, drivers: int = 1, count: int | None = None
) -> dict[str, Any]:
    """Return the overrides of `env` in which each driver drives a set of cases; `count` replaces their number."""
    curve = config.evaluation.curve
    count = count or curve.num_envs
    return {**curve.env, curve.count_key: count, **curve.cases[cases], "num_envs": drivers * count}


def build_learner(
    config: DictConfig, env: EnvBase, guides: Mapping[str, TensorDictModuleBase] | None = None
) -> Any:
    """Return the learner of a configuration, which observes `observes` and `method.observes` of an env.

    `guides` are for a learner that trains guides.
    """
    arguments: dict[str, Any] = {"guides": dict(guides or {})} if trains_guides(config) else {}
    keys = observed_keys(config)
    learner: Learner = build(config.learner, "learner", Learner, env=env, in_keys=keys, **arguments)
    return learner


def observed_keys(config: DictConfig) -> list[NestedKey]:
    """Return the keys of the entries that the agent of a configuration observes."""
    return [nested_key(key) for key in (*config.observes, *(config.method.observes or ()))]


def learner_kind(config: DictConfig) -> str:
    """Return the attribute `kind` of the learner class: `agent`, `imitation` or `guides`."""
    target = _target(config.learner.get("_target_"), "learner")
    return target.kind if isinstance(target, type) and issubclass(target, Learner) else "agent"


def trains_guides(config: DictConfig) -> bool:
    """Return whether the learner of a configuration trains guides besides the agent."""
    return learner_kind(config) == "guides"


def what_guides_see(config: DictConfig) -> dict[str, str]:
    """Return by name the attribute `sees` of the guides that may know more than an agent."""
    guides = {
        name: getattr(_target(node.get("_target_"), name), "sees", "")
        for name, node in config.guide.items()
    }
    return {name: sees for name, sees in guides.items() if sees}


def build_guides(config: DictConfig) -> dict[str, TensorDictModuleBase]:
    """Return the guides of a configuration by name; errors as `build`, also for no guide, or one without a name."""
    if "_target_" in config.guide:
        raise UserError(
            "guide: a guide needs a name, because there may be several: begin its file with "
            "# @package guide.NAME, or give +guide.NAME._target_"
        )
    if not config.guide:
        raise UserError(
            f"guide: there is none, but method={config.method.name} needs one; give guide=NAME, or method=ppo"
        )
    return {
        name: build(node, f"guide.{name}", TensorDictModuleBase)
        for name, node in config.guide.items()
    }
