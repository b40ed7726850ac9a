"""One sentence for an error of the user, of Hydra or of OmegaConf."""

import errno
import re
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    OmegaConfBaseException,
)
from yaml.error import MarkedYAMLError

from coil_rl.config import schema
from coil_rl.errors import IN_THE_WAY, NO_SPACE, UserError, did_you_mean, is_outside, lacks_memory
from coil_rl.output import printable
from coil_rl.plain_yaml import entries

# Launchers of Hydra, and the extra of the package that installs each.
LAUNCHERS = {
    "joblib": "joblib",
    "submitit_slurm": "slurm",
    "submitit_local": "slurm",
    "ray": "ray",
}
TYPED = re.compile(r"Could not override '([^']+)'")
MERGED = re.compile(r"Error merging override (.+)")
LACKED = re.compile(r"Missing mandatory value: ([\w.]+)")
NO_INTEGER = re.compile(
    r"override ([\w.]+)=.*Value '([\d.eE+]+)' of type 'float' could not be converted to Integer",
    re.DOTALL,
)
NO_NUMBER = re.compile(r"could not be converted to (Integer|Float)")
# Names of hyper-parameters elsewhere (Stable-Baselines3, CleanRL, rsl_rl), and ours.
OTHER_NAMES = {
    "lr": "learning_rate",
    "total_timesteps": "frames",
    "n_steps": "steps",
    "num_steps": "steps",
    "n_envs": "num_envs",
    "n_epochs": "epochs",
    "clip_range": "clip",
    "ent_coef": "entropy",
    "net_arch": "hidden",
    "env_id": "id",
}
SEVERAL = ("guide", "disturb", "degrade")  # groups of which several files may be chosen
OF_ENVS = {"env.id": "gym", "env.of": "torchrl", "env.options": "gym", "env.wrappers": "gym"}
ELSEWHERE = ("hydra", "defaults", "proxy", "preset")  # nodes with keys that a hint leaves out
MOST = 2  # places that a hint names


class UnknownArgumentError(UserError):
    """An argument in a configuration that its class or function does not take.

    Args:
        message: the sentence.
        key: full key of the argument.
    """

    def __init__(self, message: str, key: str) -> None:
        super().__init__(message)
        self.key = key


@contextmanager
def naming_files(files: Mapping[str, str]) -> Iterator[None]:
    """Name the user's file at the start of the message about an unknown argument.

    Args:
        files: by the keys that they give.
    """
    try:
        yield
    except UserError as error:
        # The message about the bounds of a tuned guide contains that about the guide.
        unknown = error if isinstance(error, UnknownArgumentError) else error.__cause__
        if not isinstance(unknown, UnknownArgumentError) or unknown.key not in files:
            raise
        named = f"{files[unknown.key]}: {unknown}"
        raise UserError(str(error).replace(str(unknown), named)) from error


def is_no_bug(error: BaseException) -> bool:
    """Return whether an error has a cause outside of the program.

    That is the input, the configuration, an env or controller of somebody else, or the disk.
    """
    outside = is_outside(error) or isinstance(error, OmegaConfBaseException) or lacks_memory(error)
    return outside or getattr(error, "errno", None) in (*NO_SPACE, *IN_THE_WAY)


def refuse(name: str, error: BaseException) -> NoReturn:
    """End a program with one sentence and exit code 2."""
    print(f"{name}: {sentence(error)}", file=sys.stderr)
    sys.exit(2)


def reason_of(error: Exception) -> str:
    """Return why one of several jobs failed; the traceback of a bug is printed."""
    if is_no_bug(error):
        return sentence(error)
    traceback.print_exception(error)
    return f"{type(error).__name__}: {sentence(error)}"


def sentence(error: BaseException) -> str:
    """Return the message of an error of the user, of Hydra or of OmegaConf on one line."""
    return printable(" ".join(_message(error).split()))


def _message(error: BaseException) -> str:
    """Return the message of an error, which may have several lines."""
    if isinstance(error, UserError):
        return str(error)
    if lacks_memory(error):
        return (
            "there is not enough memory; free some, or make it smaller, such as budget.num_envs or "
            "the network"
        )
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        mark = error.problem_mark
        place = "" if mark.name.startswith("<") else f"{mark.name}, "  # of a text that was read
        return f"{place}line {mark.line + 1}: it is no YAML: {error.problem}; correct it there"
    if isinstance(error, MissingConfigException):  # an OSError, too
        return _unknown_file(error)
    if isinstance(error, OSError):
        return _unusable_file(error)
    # Hydra raises these for a choice of a group that is no text.
    if isinstance(error, (AssertionError, TypeError)):
        return (
            "the command line cannot be composed; give each group a name, GROUP=CHOICE (see --help)"
        )
    if isinstance(error, OverrideParseException):
        return (
            f"{error.override!r} cannot be parsed; "
            "write KEY=VALUE, and quote special characters: 'KEY=\"VALUE\"'"
        )
    return _not_composed(error)


def _not_composed(error: BaseException) -> str:
    """Return the message for keys and values that do not fit the schema."""
    if isinstance(error, ConfigCompositionException):
        without_package = file_without_package(str(error))
        if without_package:
            return without_package
    for key_error in (error, error.__cause__):
        if isinstance(key_error, (ConfigAttributeError, ConfigKeyError)):
            return _unknown_key(key_error, TYPED.search(str(error)))
    merged = MERGED.match(str(error))
    if merged is not None:
        problem = _wrong_kind(merged[1], f"{error} {error.__cause__}")
        if problem:
            return problem
    if isinstance(error, OmegaConfBaseException) and error.full_key:
        return _wrong_value(error, error.full_key)
    if isinstance(error.__cause__, OmegaConfBaseException):
        return f"{_first_paragraph(error)}: {_first_paragraph(error.__cause__)}"
    return _first_paragraph(error)


def _wrong_kind(override: str, cause: str) -> str:
    """Return the message for a value of another kind than its key has, or an empty string."""
    key, _, value = override.partition("=")
    number = NO_INTEGER.search(cause)
    if number is not None and float(number[2]).is_integer():
        return (
            f"{number[1]}={number[2]} must be a whole number; "
            f"write {number[1]}={int(float(number[2])):_}"
        )
    kind = NO_NUMBER.search(cause)
    if kind is not None:
        return f"{override} must be a {'whole ' if kind[1] == 'Integer' else ''}number"
    if "is not a ListConfig" in cause:
        return f"{override} must be a list; write {key}=[{value}]"
    return ""


def _unusable_file(error: OSError) -> str:
    """Return the message for a file that cannot be read or written."""
    name = error.filename or "the output"
    if error.errno == errno.ENAMETOOLONG:
        longest = max(Path(name).parts, key=len)  # the last one may be that of a file in it
        return f"{longest[:60]}... cannot be used ({error.strerror}); choose a shorter name"
    if error.errno in IN_THE_WAY:
        return (
            f"{name} cannot be used ({error.strerror}); "
            "put the right file or folder there, with the right to use it"
        )
    return f"{name} cannot be used ({error.strerror}); choose another folder, or make room"


def _unknown_file(error: MissingConfigException) -> str:
    """Return the message for a choice of a group that has no YAML file."""
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    if not group:
        return _first_paragraph(error)
    if group == "hydra/launcher" and name in LAUNCHERS:
        return (
            f"hydra/launcher={name} is not installed: "
            f"python -m pip install 'coil-rl[{LAUNCHERS[name]}]'"
        )
    options = sorted(error.options or schema.shipped(group))  # Hydra knows none of a list
    if not options:
        return f"there is no {group}={name}{choice(group, name, options)}"
    return (
        f"there is no {group}={name}; "
        f"{group} can be {', '.join(options)}{choice(group, name, options)}"
    )


def _unknown_key(error: OmegaConfBaseException, typed: re.Match[str] | None) -> str:
    """Return the message for a key that the configuration does not have.

    `typed` is what was typed, where the key is only its first part.
    """
    key, parent = str(error.full_key or error.key), error.parent_node
    names = parent if isinstance(parent, DictConfig) else []
    known = [str(name) for name in names if name not in ("hydra", "defaults")]
    node = key.rpartition(".")[0] or "the configuration"
    swept = [word for word in sys.argv if word.startswith(f"{key.partition('.')[0]}=")]
    # Hydra composes a sweep without the files that it sweeps.
    if any("," in word for word in swept):
        return f"there is no key {key} before {swept[0]} is chosen; write {key}=choice(VALUE)"
    other_file = unchosen(key, typed[1] if typed else key)
    if other_file:
        return f"there is no key {key}{other_file}"
    hint = similar(str(error.key), known)
    if not hint and parent is not None:
        hint = where(typed[1] if typed else key, parent._get_root())
    # The arguments of a part are all in its node.
    takes_any = parent is not None and OmegaConf.get_type(parent) is dict
    add = f"; +{key}=VALUE adds it" if takes_any and "_target_" not in names else ""
    return f"there is no key {key}; {node} has {', '.join(known) or 'none'}{add}{hint}"


def _wrong_value(error: OmegaConfBaseException, key: str) -> str:
    """Return the message for the value of a key that is missing or cannot be used."""
    lacked = LACKED.search(str(error))
    if lacked is not None:
        key = key if isinstance(error, MissingMandatoryValue) else lacked[1]
        return f"{key} must be given: write {key}=VALUE"
    return f"{key}: {_first_paragraph(error)}"


def _first_paragraph(error: BaseException) -> str:
    """Return the first paragraph of an error's text, without what only developers can use."""
    kept = []
    for line in str(error).partition("\n\n")[0].splitlines():
        # Indented lines hold OmegaConf's internals.
        if line.strip() and not line.startswith((" ", "\t", "See http")):
            kept.append(line.strip())
    return " ".join(kept) or type(error).__name__


def similar(given: str, known: Iterable[str]) -> str:
    """Return `; did you mean X?` for a name among some known ones, or an empty string."""
    if given == "run":
        return "; to go on with a run write resume=FOLDER"
    known = list(known)
    other = OTHER_NAMES.get(given)
    return f"; did you mean {other}?" if other in known else did_you_mean(given, known)


def where(key: str, root: Any) -> str:
    """Return `; did you mean KEY?` for a key that is in another place of the configuration.

    A key that exists is in its place already: only what it is to hold does not fit.
    """
    if not isinstance(root, DictConfig):
        return ""
    group, _, last = key.rpartition(".")
    wanted = {last, OTHER_NAMES.get(last, last)}
    values: Any = OmegaConf.to_container(root, resolve=False)
    kept = {name: values[name] for name in values if name not in ELSEWHERE}
    found = [full for full, last, _ in entries(kept) if last in wanted]
    if key in found:
        return ""
    # A key of the group that was typed is more likely than one of another.
    first = group.partition(".")[0]
    found.sort(key=lambda full: (full.partition(".")[0] != first, full.count(".")))
    return f"; did you mean {' or '.join(found[:MOST])}?" if found else ""


def unchosen(key: str, typed: str) -> str:
    """Return `; ...` for the key of a file that exists and was not chosen, or an empty string.

    Args:
        key: that does not exist, such as "guide.controller".
        typed: the key that was typed, such as "guide.controller.of".
    """
    env = OF_ENVS.get(key)
    if env is not None:
        return f"; it belongs to env={env}: write env={env} {typed}=VALUE"
    group, _, name = key.partition(".")
    if group not in SEVERAL or name not in schema.shipped(group):
        return ""
    chosen = name if group == "guide" else f"[{name}]"
    return f"; it belongs to {group}={name}: write {group}={chosen} {typed}=VALUE"


def choice(group: str, name: str, options: Iterable[str]) -> str:
    """Return `; ...` with what to write instead of a choice of a group that has no file.

    Args:
        group: such as "env".
    """
    if group == "env" and re.search(r":|-v\d+$", name):
        return f"; for an env of Gymnasium write env=gym env.id={name}"
    if group == "guide" and ":" in name:
        return f"; for a controller of your own write guide=controller guide.controller.of={name}"
    return similar(name, options)


def file_without_package(message: str) -> str:
    """Return the sentence for a YAML file whose keys do not fit, or an empty string.

    Without its package line Hydra puts the nodes of the root into that of its group.

    Args:
        message: of Hydra, for a file whose keys do not fit.
    """
    chosen = re.search(r"In '([\w/]+)': Could not override '\w+@\w+\.", message)
    if chosen is not None:
        return f"{chosen[1]}.yaml: begin the file with the line # @package _global_"
    found = re.search(r"In '([\w/]+)/([^'/]+)'.*Key '(\w+)' not in '(\w+)'", message, re.DOTALL)
    if found is None:
        return ""
    group, name, key, kind = found.groups()
    if key not in schema.TrainConfig.__dataclass_fields__:
        known = list(vars(schema)[kind].__dataclass_fields__)
        return (
            f"{group}/{name}.yaml: {group} has no key {key}; it has {', '.join(known)}"
            f"{did_you_mean(key, known)}"
        )
    return (
        f"{group}/{name}.yaml: Hydra puts its keys under {group}, which has no key {key}; begin "
        "the file with the line # @package _global_"
    )
