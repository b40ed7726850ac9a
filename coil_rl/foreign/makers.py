"""Makers of Gymnasium envs: how one is found by its name and called, and why it cannot be."""

import importlib
import inspect
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import gymnasium
from gymnasium import error as errors
from gymnasium.envs.registration import load_env_creator
from gymnasium.wrappers import TimeLimit

from coil_rl.errors import did_you_mean
from coil_rl.foreign.faults import shortened, shown
from coil_rl.foreign.limit import layers

# What an error about a missing package mentions, and the extra of coil-rl that installs it.
EXTRAS = {"box2d": "gym", "pygame": "gym", "mujoco": "mujoco", "minigrid": "babyai"}

# Wrappers that normalise by statistics, and what to do instead.
STATISTICS = {
    "NormalizeObservation": " and give learner.normalise=true",
    "NormalizeReward": ", returns are the env's own",
}
SPACES = ("action_space", "observation_space")
Env = gymnasium.Env[Any, Any]


def maker_of(id: str | Callable[..., Env]) -> str | Callable[..., Env]:
    """Return the maker that MODULE:NAME names, if it is no registered name; else `id` itself."""
    if not isinstance(id, str) or ":" not in id:
        return id
    module, _, name = id.partition(":")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return id  # Gymnasium says what is wrong
    return found if callable(found) and name not in gymnasium.registry else id


def registered_maker(id: str) -> Any:
    """Return what makes a registered env.

    Args:
        id: as in NAME or MODULE:NAME, of which the module registers the name.

    Raises:
        gymnasium.error.Error: for a name that is not registered.
    """
    module, _, name = id.rpartition(":")
    if module:
        importlib.import_module(module)
    maker = gymnasium.spec(name).entry_point
    return load_env_creator(maker) if isinstance(maker, str) else maker


def name_of(maker: str | Callable[..., Env]) -> str:
    """Return the name of an env for messages."""
    made = getattr(maker, "func", maker)  # by a partial
    return made if isinstance(made, str) else getattr(made, "__qualname__", repr(made))


def make_env(
    maker: str | Callable[..., Env],
    wrappers: Sequence[Callable[[Env], Env]],
    settings: Mapping[str, Any],
) -> Env:
    """Return an env in its wrappers; a `ValueError` says why it cannot be made."""
    name = name_of(maker)
    try:
        if isinstance(maker, str):
            env: Env = gymnasium.make(maker, **{"disable_env_checker": True, **settings})
        else:
            env = _called(maker, settings)
        if (steps := settings.get("max_episode_steps")) is not None:
            env = _limited(env, steps)
        for wrapper in wrappers:
            env = wrapper(env)
        found = {which: getattr(env, which, None) for which in SPACES}
    except (Exception, SystemExit) as error:
        raise ValueError(f"the env {name} cannot be made: {_reason(name, error)}") from error
    if not isinstance(env, gymnasium.Env):
        remedy = (
            "give the env of one row, of which a run makes budget.num_envs"
            if isinstance(env, gymnasium.vector.VectorEnv)
            else "derive its class from gymnasium.Env"
        )
        raise ValueError(f"the env {name} is {shown(env)}, not an env of Gymnasium: {remedy}")
    for which, space in found.items():
        if not isinstance(space, gymnasium.Space):
            raise ValueError(
                f"the {which} of {name} is {shown(space)}, not a space of Gymnasium: set it in its "
                "__init__"
            )
    _check_statistics(env, name)
    return env


def _check_statistics(env: Env, name: str) -> None:
    """Refuse wrappers that normalise by statistics, which a new env of an evaluation lacks."""
    for layer in layers(env):
        for kind, remedy in STATISTICS.items():
            if any(each.__name__.startswith(kind) for each in type(layer).__mro__):
                raise ValueError(
                    f"the env {name} has the wrapper {type(layer).__name__}, whose statistics an "
                    f"evaluation begins anew; leave it out{remedy}"
                )


def _called(maker: Callable[..., Env], settings: Mapping[str, Any]) -> Env:
    """Return the env of a maker, which gets the options that it takes."""
    options = dict(settings)
    options.pop("max_episode_steps", None)
    parameters = inspect.signature(maker).parameters.values()
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    if not takes_any and "render_mode" not in [parameter.name for parameter in parameters]:
        options.pop("render_mode", None)
    return maker(**options)


def _limited(env: Env, steps: int) -> Env:
    """Return an env whose episodes end after a number of steps, also if it had another limit."""
    limits = [layer for layer in layers(env) if isinstance(layer, TimeLimit)]
    for limit in limits:  # a further one could only shorten the episodes
        limit._max_episode_steps = steps
    return env if limits else TimeLimit(env, steps)


def _reason(id: str, error: BaseException) -> str:
    """Return in a few words why an env cannot be made, with a remedy where one is known."""
    extra = next((EXTRAS[name] for name in EXTRAS if name in f"{id} {error}".lower()), None)
    if extra and isinstance(error, (errors.DependencyNotInstalled, ModuleNotFoundError)):
        return f"a package is not installed: python -m pip install 'coil-rl[{extra}]'"
    module, _, name = id.rpartition(":")
    package = module.partition(".")[0]
    if package and isinstance(error, ModuleNotFoundError) and find_spec(package) is None:
        return f"there is no module {package}; install its package, or add its folder to PYTHONPATH"
    if not isinstance(error, errors.Error):  # of the env itself
        text = shortened(re.split(r" was raised from", str(error).strip())[0])
        return f"it raised {type(error).__name__}: {text}" if text else type(error).__name__
    first_line = re.split(r"\n| was raised from", str(error).strip())[0].rstrip(".")
    if not id:
        return "env.id is empty; write env.id=MODULE:NAME, or the id of a registered env"
    if not isinstance(error, (errors.NameNotFound, errors.NamespaceNotFound)):
        return first_line or type(error).__name__
    if module:
        things = vars(sys.modules[module]) if module in sys.modules else {}
        known = [each for each, thing in things.items() if callable(thing)]
        hint = did_you_mean(name, [*known, *gymnasium.registry])
        return f"{module} has no env {name}, and registers none of this name{hint}"
    # Gymnasium may have a suggestion of its own: "Did you mean ...".
    if "mean" in first_line:
        return first_line
    return (
        f"{first_line}; write MODULE:NAME for an env of a module, or PACKAGE:{id} if a package "
        "registers it"
    )


def metadata_of(env: Env, key: str, default: Any) -> Any:
    """Return an entry of the metadata of an env, which may have none."""
    metadata = getattr(env, "metadata", None)
    return (metadata.get(key) or default) if isinstance(metadata, Mapping) else default
