"""One sentence for an error of the user, of Hydra or of OmegaConf."""

import errno
import re
import sys
from pathlib import Path
from typing import NoReturn

from hydra.errors import (
    ConfigCompositionException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationKeyError,
    OmegaConfBaseException,
)

from coil_rl.config import hints
from coil_rl.errors import IN_THE_WAY, NO_SPACE, UserError, is_outside
from coil_rl.run.folder import is_begun

# Launchers of Hydra, and the extra of the package that installs each.
LAUNCHERS = {
    "joblib": "joblib",
    "submitit_slurm": "slurm",
    "submitit_local": "slurm",
    "ray": "ray",
}


TYPED = re.compile(r"Could not override '([^']+)'")
MERGED = re.compile(r"Error merging override (.+)")
NO_GROUP = re.compile(r"(?:In '([^']+)': )?Could not override '([\w/]+)'\. No match")
NO_CHOICE = "Config group override must be a string or a list"
NO_INTEGER = re.compile(
    r"override ([\w.]+)=.*Value '([\d.eE+]+)' of type 'float' could not be converted to Integer",
    re.DOTALL,
)


def is_no_bug(error: BaseException) -> bool:
    """Return whether an error has a cause outside of the program.

    That is the input, the configuration, an env or controller of somebody else, or the disk.
    """
    outside = is_outside(error) or isinstance(error, OmegaConfBaseException)
    return outside or getattr(error, "errno", None) in (*NO_SPACE, *IN_THE_WAY)


def refuse(name: str, error: BaseException) -> NoReturn:
    """End a program with one sentence and exit code 2.

    Args:
        name: of the program.
        error: with a cause outside of it.
    """
    print(f"{name}: {sentence(error)}", file=sys.stderr)
    sys.exit(2)


def sentence(error: BaseException) -> str:
    """Return the message of an error of the user, of Hydra or of OmegaConf on one line."""
    return " ".join(_message(error).split())


def _message(error: BaseException) -> str:
    """Return the message of an error, which may have several lines."""
    if isinstance(error, UserError):
        return str(error)
    if isinstance(error, MissingConfigException):  # an OSError, too
        return _unknown_file(error)
    if isinstance(error, OSError):
        return _unusable_file(error)
    # Hydra raises these for a choice of a group that is no text.
    if isinstance(error, (AssertionError, TypeError)):
        return (
            "the command line cannot be composed; give each group a name, GROUP=CHOICE (see --help)"
        )
    if str(error).startswith(NO_CHOICE):  # it does not say which group
        return (
            "a group takes the name of a file, not null or a number; write GROUP=NAME, "
            "logger=none, disturb=[] or degrade=[], or leave it out"
        )
    if isinstance(error, OverrideParseException):
        return _unreadable_override(error)
    return _not_composed(error)


def _not_composed(error: BaseException) -> str:
    """Return the message for keys and values that do not fit the schema."""
    if isinstance(error, ConfigCompositionException):
        without_package = hints.file_without_package(str(error))
        if without_package:
            return without_package
    group = NO_GROUP.match(str(error))
    if group is not None and group[2] in hints.OF_CONES:
        return _group_of_cones(group[1], group[2])
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
    """Return the message for a value of another kind than its key has, or an empty string.

    Args:
        override: as typed.
        cause: what OmegaConf says.
    """
    key, _, value = override.partition("=")
    number = NO_INTEGER.search(cause)
    if number is not None and float(number[2]).is_integer():
        return (
            f"{number[1]}={number[2]} must be a whole number; "
            f"write {number[1]}={int(float(number[2])):_}"
        )
    if "could not be converted to Integer" in cause:
        return f"{override} must be a whole number"
    if "could not be converted to Float" in cause:
        return f"{override} must be a number"
    if "is not a valid bool" in cause or "could not be converted to Boolean" in cause:
        return f"{override} must be true or false"
    if "is not a ListConfig" in cause:
        return f"{override} must be a list; write {key}=[{value}]"
    if "does not support deletion" in cause:
        return f"{override}: {key.lstrip('~')} cannot be left out; give it another value"
    return ""


def _group_of_cones(file: str | None, group: str) -> str:
    """Return the message for a group that only the cone world has, and another env is chosen.

    Args:
        file: in whose defaults list it is overridden, without its suffix; None: the command line.
        group: such as "track".
    """
    has = f"only the cone world (env=cone_track) has the group {group}"
    if file is None:
        return f"{group}= cannot be given for this env: {has}; leave it out"
    return (
        f"{file}.yaml overrides /{group}, but {has}: leave env= out, or write in the file, instead "
        f"of that line, override /env: NAME, of an env file that does it (as "
        "env/cone_track_unseen.yaml), so that another env replaces it"
    )


def _unreadable_override(error: OverrideParseException) -> str:
    """Return the message for an argument that is no KEY=VALUE."""
    if is_begun(Path(error.override)):
        return f"{error.override!r} is the folder of a run; write run={error.override} (see --help)"
    return (
        f"{error.override!r} cannot be parsed; "
        "write KEY=VALUE, and quote special characters: 'KEY=\"VALUE\"'"
    )


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
    return (
        f"{name} cannot be used ({error.strerror}); choose another folder with hydra.run.dir=FOLDER"
    )


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
    options = sorted(error.options or [])
    if not options:
        return f"there is no {group}={name}{hints.choice(group, name, options)}"
    return (
        f"there is no {group}={name}; "
        f"{group} can be {', '.join(options)}{hints.choice(group, name, options)}"
    )


def _unknown_key(error: OmegaConfBaseException, typed: re.Match[str] | None) -> str:
    """Return the message for a key that the configuration does not have.

    `typed` is what was typed, where the key is only its first part.
    """
    key, parent = str(error.full_key or error.key), error.parent_node
    names = parent if isinstance(parent, DictConfig) else []
    known = [str(name) for name in names if name not in ("hydra", "defaults")]
    node = key.rpartition(".")[0] or "the configuration"
    unchosen = hints.unchosen(key, typed[1] if typed else key)
    if unchosen:
        return f"there is no key {key}{unchosen}"
    hint = hints.similar(str(error.key), known)
    if not hint and parent is not None:
        hint = hints.where(typed[1] if typed else key, parent._get_root())
    # The arguments of a part are all in its node.
    takes_any = parent is not None and OmegaConf.get_type(parent) is dict
    add = f"; +{key}=VALUE adds it" if takes_any and "_target_" not in names else ""
    return f"there is no key {key}; {node} has {', '.join(known) or 'none'}{add}{hint}"


def _wrong_value(error: OmegaConfBaseException, key: str) -> str:
    """Return the message for the value of a key that is missing or cannot be used."""
    if isinstance(error, MissingMandatoryValue):
        return f"{key} must be given: write {key}=VALUE"
    if isinstance(error, InterpolationKeyError):
        missing, group = str(error).split("'")[1], key.partition(".")[0]
        return (
            f"{key} refers to {missing}, which does not exist; "
            f"choose another {group}, or give {key}=VALUE"
        )
    return f"{key}: {_first_paragraph(error)}"


def _first_paragraph(error: BaseException) -> str:
    """Return the first paragraph of an error's text, without what only developers can use."""
    kept = []
    for line in str(error).partition("\n\n")[0].splitlines():
        # Indented lines hold OmegaConf's internals.
        if line.strip() and not line.startswith((" ", "\t", "See http")):
            kept.append(line.strip())
    return " ".join(kept) or type(error).__name__
