"""From the words of a command line and YAML files to a configuration: Hydra composes it.

What a person wrote is what runs. Hydra composes the groups in a fixed order, env before learner
before method. So a value of a later group replaces the one that a user wrote in a file of an
earlier group, `learner: {normalise: true}` in a file of an env for example, and nobody says so.
Here every value that is written in a file of somebody else than coil-rl is put into its place
again, unless the command line gives another one.

Guests, packages beside coil-rl, bring YAML files of envs, guides, experiments and programs. A guest
names the package of its files by an entry point, and Hydra then finds them like those of coil-rl,
by the names of their folders:

    [project.entry-points."coil_rl.conf"]
    my_package = "my_package.conf"
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib import metadata, resources
from importlib.resources.abc import Traversable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.messages import SEVERAL, sentence
from coil_rl.errors import UserError
from coil_rl.plain_yaml import entries

CORE = "coil_rl.conf"  # the package of our own files, and the group of the entry points
# Of the last composition: the file of a user by each key that it gives.
WRITTEN: dict[str, str] = {}

REFERENCE = re.compile(r"\$\{(?:oc\.select:)?([\w.]+)")


@cache
def packages() -> tuple[str, ...]:
    """Return the packages with YAML files, coil-rl's own first."""
    return (CORE, *sorted(entry.value for entry in metadata.entry_points(group=CORE)))


@cache
def shipped_places() -> tuple[str, ...]:
    """Return where Hydra finds its own files, and those that are installed with coil-rl."""
    entries = metadata.entry_points(group=CORE)
    ours = sorted(each.value for each in entries if each.dist and each.dist.name == "coil-rl")
    return ("pkg://hydra", "structured://", *(f"pkg://{package}" for package in (CORE, *ours)))


class GuestFiles(SearchPathPlugin):
    """Lets Hydra find the files of all of them in a program whose own file is in one of them."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append what is not there."""
        places = [f"pkg://{package}" for package in packages()]
        known = {element.path for element in search_path.get_path()}
        if not known.isdisjoint(places):
            for place in places:
                if place not in known:
                    search_path.append(CORE, place)


Plugins.instance().register(GuestFiles)


def keep_written(
    config: DictConfig, hydra: Any, task: Sequence[str], others: Sequence[str] = ()
) -> None:
    """Put the values of users' files into their places, after Hydra has composed all files.

    The order of Hydra's defaults list cannot say it: a method is meant to replace what a shipped
    env file says of the learner, and not what a user's file of an env says.

    Args:
        config: composed by a Hydra that is initialised; it is changed in place.
        task: overrides of the command line for the program.
        others: overrides of the command line for Hydra.

    Raises:
        UserError: for a word that chooses several files of a group that takes one.
    """
    loader = GlobalHydra.instance().config_loader()
    groups = {str(group).replace("/", ".") for group in hydra.runtime.choices}
    groups |= set(loader.list_groups(""))  # a choice of several files is not among the first
    for text in task:
        group, value = key_of(text), text.partition("=")[2]
        if group in groups.difference(SEVERAL) and value.startswith("["):
            raise UserError(
                f"{text} chooses several files of a group that takes one; for a run with each "
                f"write -m {group}={value.strip('[]')}"
            )
    WRITTEN.clear()
    places = [f"{place.schema}://{place.path}" for place in hydra.runtime.config_sources]
    # To look for files of users takes as long as to compose all files.
    if all(place.startswith(shipped_places()) for place in places):
        return
    name, words = hydra.job.config_name, [*task, *others]
    defaults = loader.compute_defaults_list(name, words, RunMode.RUN).defaults
    # A choice of a file, such as method=coil, gives no value.
    typed = [key for key in map(key_of, task) if key not in groups]
    with open_dict(config):
        for key, value, file in _written(defaults, places):
            WRITTEN[key] = file
            if not any(covers(each, key) for each in typed):
                OmegaConf.update(config, key, value, merge=False, force_add=True)


def key_of(text: str) -> str:
    """Return the full key of an override of the command line.

    Args:
        text: such as "+learner.gamma=0.9", "~degrade" or "guide@other=spline".
    """
    return text.lstrip("+~").partition("=")[0].rpartition("@")[2].replace("/", ".")


def quoted(text: str) -> str:
    """Return a text as Hydra reads it: a plain name as it is, others in quotes.

    In these a backslash is special before a quote only.

    Args:
        text: a value for an override on the command line.
    """
    if re.fullmatch(r"(?ai)(?!(null|true|false|nan|inf)$)[a-z][\w.:/-]*", text):
        return text
    escaped = re.sub(r"(\\*)('|$)", lambda found: found[1] * 2 + ("\\'" if found[2] else ""), text)
    return f"'{escaped}'"


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
        for key, _, value in entries(values, default.package or ""):
            is_node = isinstance(value, Mapping)
            if not is_node and key.partition(".")[0] not in ("hydra", "defaults"):
                yield key, value, name


def _file(place: str, name: str) -> Traversable:
    """Return a file in a folder or a package, such as "pkg://coil_rl.conf"."""
    kind, _, where = place.partition("://")
    if kind == "pkg" and find_spec(where.replace("/", ".")) is not None:
        return resources.files(where.replace("/", ".")) / name
    return Path(where) / name


def compose_train(words: Sequence[str], *, with_hydra: bool = False) -> DictConfig:
    """Return the configuration that `coil-train` composes from the words of its command line.

    Args:
        words: such as "method=coil" and "+experiment=placebo". YAML files of another package are
            found with "hydra.searchpath=[pkg://PACKAGE.conf]".
        with_hydra: whether the configuration has Hydra's own part, such as the folders of a sweep.

    Raises:
        UserError: for words that do not fit the configuration, with one sentence.
    """
    try:
        with _own_hydra():
            config = compose("train", list(words), return_hydra_config=True)
            task = [word for word in words if not word.startswith("hydra.")]
            keep_written(config, config.hydra, task, [w for w in words if w not in task])
            if not with_hydra:
                with open_dict(config):
                    del config["hydra"]
            return config
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
