"""From the words of a command line and YAML files to a configuration: Hydra composes it.

What a person wrote is what runs. Hydra composes the groups in a fixed order, env before learner
before method. So a value of a later group replaces the one that a user wrote in a file of an
earlier group, `learner: {normalise: true}` in a file of an env for example, and nobody says so.
Here every value that is written in a file of somebody else than coil-rl is put into its place
again, unless the command line gives another one.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import fields
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException
from pydantic import TypeAdapter, ValidationError

from coil_rl.config.messages import SEVERAL, sentence, similar
from coil_rl.config.schema import shipped_places
from coil_rl.errors import UserError
from coil_rl.measures import measures_of
from coil_rl.output import say
from coil_rl.plain_yaml import entries
from coil_rl.ranges import validation_message

REFERENCE = re.compile(r"\$\{(?:oc\.select:)?([\w.]+)")
LARGEST_BATCH = 2**28  # frames
ANY_ENV = ("fmu", "gym", "torchrl")  # files of conf/env that stand for any env
FRAMES = 100_000  # 3.5 minutes of the processor with SAC, where the steps of an env are fast


def keep_written(config: DictConfig, hydra: Any) -> dict[str, str]:
    """Put the values of users' files into their places, after Hydra has composed all files.

    The order of Hydra's defaults list cannot say it: a method is meant to replace what a shipped
    env file says of the learner, and not what a user's file of an env says.

    Args:
        config: composed by a Hydra that is initialised; it is changed in place.
        hydra: Hydra's part of it.

    Returns:
        The file of a user by each key that it gives.

    Raises:
        UserError: for a word that chooses several files of a group that takes one.
    """
    loader = GlobalHydra.instance().config_loader()
    task, others = typed(hydra)
    groups = {str(group).replace("/", ".") for group in hydra.runtime.choices}
    groups |= set(loader.list_groups(""))  # a choice of several files is not among the first
    for text in task:
        group, value = key_of(text), text.partition("=")[2]
        if group in groups.difference(SEVERAL) and value.startswith("["):
            raise UserError(
                f"{text} chooses several files of a group that takes one; for a run with each "
                f"write -m {group}={value.strip('[]')}"
            )
    places = [f"{place.schema}://{place.path}" for place in hydra.runtime.config_sources]
    # To look for files of users takes as long as to compose all files.
    if all(place.startswith(shipped_places()) for place in places):
        return {}
    name = hydra.job.config_name
    defaults = loader.compute_defaults_list(name, [*task, *others], RunMode.RUN).defaults
    # A choice of a file, such as method=coil, gives no value.
    given = [key for key in map(key_of, task) if key not in groups]
    files = {}
    with open_dict(config):
        for key, value, file in _written(defaults, places):
            files[key] = file
            if not any(covers(each, key) for each in given):
                OmegaConf.update(config, key, value, merge=False, force_add=True)
    return files


def typed(hydra: Any) -> tuple[list[str], list[str]]:
    """Return the words of a command line for the program, and those for Hydra, as typed.

    References in them stay.

    Args:
        hydra: Hydra's part of the configuration.
    """
    given: Any = OmegaConf.to_container(hydra.overrides, resolve=False)
    return given["task"], given["hydra"]


def key_of(text: str) -> str:
    """Return the full key of an override of the command line.

    Args:
        text: such as "+learner.gamma=0.9", "~degrade" or "guide@other=spline".
    """
    return text.lstrip("+~").partition("=")[0].rpartition("@")[2].replace("/", ".")


def quoted(text: str) -> str:
    """Return a text as a value in a word of the command line: in quotes unless it is a plain name.

    Args:
        text: a value for an override on the command line.
    """
    if re.fullmatch(r"(?ai)(?!(null|true|false|nan|inf)$)[a-z][\w.:/-]*", text):
        return text
    return QuotedString(text, Quote.single).with_quotes()


def covers(one: str, other: str) -> bool:
    """Return whether one of two keys is the other, or is inside it."""
    return one == other or other.startswith(f"{one}.") or one.startswith(f"{other}.")


def _written(defaults: Iterable[Any], places: Sequence[str]) -> Iterator[tuple[str, Any, str]]:
    """Yield full key, value and file of what users' files give, in the order of composition.

    Args:
        defaults: Hydra's defaults list.
        places: folders and packages of the files, in the order in which Hydra looks.
    """
    for default in defaults:
        name = f"{default.config_path}.yaml"
        found = [(place, file) for place in places if (file := _file(place, name)).is_file()]
        if default.config_path is None or not found or found[0][0].startswith(shipped_places()):
            continue
        content = OmegaConf.create(found[0][1].read_text(encoding="utf-8"))
        values: Any = OmegaConf.to_container(content, resolve=False)
        values.pop("defaults", None)  # Hydra's list of files
        for key, _, value in entries(values, default.package or ""):
            if not isinstance(value, Mapping) and key.partition(".")[0] != "hydra":
                yield key, value, name


def _file(place: str, name: str) -> Traversable:
    """Return a file in a folder or a package, such as "pkg://coil_rl.conf"."""
    kind, _, where = place.partition("://")
    if kind == "pkg" and find_spec(where.replace("/", ".")) is not None:
        return resources.files(where.replace("/", ".")) / name
    return Path(where) / name


class Composed(NamedTuple):
    """A composed configuration, and the files of users that give its values."""

    config: DictConfig
    files: dict[str, str]  # by the keys that they give


def compose_train(words: Sequence[str], *, with_hydra: bool = False) -> DictConfig:
    """Return the configuration that `coil-train` composes from the words of its command line.

    Args:
        words: such as "method=coil" and "+experiment=placebo". YAML files of another package are
            found with "hydra.searchpath=[pkg://PACKAGE.conf]".
        with_hydra: whether the configuration has Hydra's own part, such as the folders of a sweep.

    Raises:
        UserError: for words that do not fit the configuration, with one sentence.
    """
    return compose_with_files(words, with_hydra=with_hydra).config


def compose_with_files(words: Sequence[str], *, with_hydra: bool = False) -> Composed:
    """Compose as `compose_train` does, and return the files of users too."""
    try:
        with _own_hydra():
            config = compose("train", list(words), return_hydra_config=True)
            files = keep_written(config, config.hydra)
            if not with_hydra:
                with open_dict(config):
                    del config["hydra"]
            return Composed(config, files)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(sentence(error)) from error


@contextmanager
def _own_hydra() -> Iterator[None]:
    """Compose files of this package in the block.

    This works inside a program of Hydra with its own files, too.
    """
    program = GlobalHydra.instance()
    outer = program.hydra
    program.clear()
    try:
        with initialize_config_module("coil_rl.conf", version_base="1.3"):
            yield
    finally:
        GlobalHydra.instance().hydra = outer


def check_values(config: DictConfig) -> None:
    """Check the values of the configuration of any program.

    Args:
        config: composed by Hydra, or read from a folder.

    Raises:
        UserError: for an unknown key, or a value out of range.
    """
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    schema: Any = OmegaConf.get_type(config)
    try:
        _adapter(schema).validate_python(values)
    except ValidationError as error:
        for detail in error.errors():
            if detail["type"] == "unexpected_keyword_argument":
                raise UserError(_unknown_key(config, *map(str, detail["loc"]))) from None
        raise UserError(validation_message(error, values)) from None
    measures_of(values.get("evaluation", {}).get("measures", {}))
    for name in ("budget", "proxy.budget"):
        budget = OmegaConf.select(config, name)
        if (
            isinstance(budget, DictConfig)
            and (frames := budget.num_envs * budget.steps) > LARGEST_BATCH
        ):
            raise UserError(
                f"{name}.num_envs x {name}.steps={frames} must be at most {LARGEST_BATCH}"
            )
    for name in ("device", "env.device"):
        if isinstance(device := OmegaConf.select(config, name), str):
            _check_device(config, name, device)


def _check_device(config: DictConfig, name: str, device: str) -> None:
    """Raise a `UserError` for a device that is unknown, is not there or cannot do what is asked."""
    if device == "cpu":
        return
    if not re.fullmatch(r"cuda(:\d+)?", device):
        raise UserError(f"{name}={device} must be cpu, cuda, or one GPU such as cuda:0")
    if OmegaConf.select(config, "compile"):
        raise UserError(
            f"compile=true is for the CPU only, not for {name}={device}; take compile=false"
        )
    import torch  # here, so that help and a wrong word do not wait for it

    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError) as error:
        problem = str(error).splitlines()[0]
        raise UserError(f"{name}={device} cannot be used ({problem}); take {name}=cpu") from error


@cache
def _adapter(schema: type) -> TypeAdapter[Any]:
    """Return the validator of a schema, which takes longer to make than to use."""
    return TypeAdapter(schema)


def _unknown_key(config: DictConfig, *path: str) -> str:
    *parents, key = path
    name = ".".join(parents)
    schema: Any = OmegaConf.get_type(OmegaConf.select(config, name) if name else config)
    known = [field.name for field in fields(schema) if field.name != "defaults"]
    return (
        f"there is no key {key}; {name or 'the configuration'} has {', '.join(known)}"
        f"{similar(key, known)}"
    )


def default_learner(
    words: Iterable[str], compose: Callable[[list[str]], DictConfig] = compose_train
) -> list[str]:
    """Return the words that select SAC, or none if the command or the env excludes it.

    SAC needs far fewer frames where actions are numbers (docs/learners.md), and cannot learn
    choices. Hydra composes the learner before the env exists. So the env is made once before, and
    the choice becomes words of the command, which the folder of the run keeps.

    A learner, a network, an experiment, a policy to begin with and a method are a choice, but for
    `coil_anchored`, which is the default method with a guide.

    An env that cannot be made gives none: the run says what is wrong with it.

    Args:
        words: of the command line.
        compose: returns the configuration for some of them.
    """
    given = {key_of(word): word for word in words}
    kind, method = (given.get(key, "").partition("=")[2] for key in ("env", "method"))
    chosen = given.keys() & {"experiment", "init", "learner", "network", "resume"}
    if kind not in ANY_ENV or chosen or method not in ("", "coil_anchored"):
        return []
    read = ("env", "hydra.searchpath", "budget.frames")
    of_env = [word for key, word in given.items() if key.startswith(read)]
    with suppress(Exception):
        config = compose([*of_env, "learner=sac"])
        if _acts_in_numbers(config):
            more = [f"budget.frames={FRAMES}"]
            if "budget.frames" in given:
                # A very short run learns too: its first quarter is stored without learning.
                frames, starts = config.budget.frames, config.learner.starts
                is_short = frames < 4 * starts and "learner.starts" not in given
                more = [f"learner.starts={frames // 4}"] if is_short else []
            say("learner=sac, because actions are numbers (for PPO write learner=ppo)")
            return ["learner=sac", *more]
    return []


def _acts_in_numbers(config: DictConfig) -> bool:
    """Return whether SAC can learn in the env of a configuration."""
    from coil_rl.config.parts import build_bare_env  # imports torch
    from coil_rl.learners.off_policy import check_replay

    few = {"num_envs": 1} | ({"workers": 0} if "workers" in config.env else {})
    with closing(build_bare_env(config, few)) as env:
        check_replay(env, "SAC")
        return env.action_spec.dtype.is_floating_point
