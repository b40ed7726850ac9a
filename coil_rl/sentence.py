"""What Hydra and OmegaConf say about a mistake, in one sentence: what was given, what exists, what to do."""

from __future__ import annotations

import re
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    ConfigTypeError,
    InterpolationKeyError,
    OmegaConfBaseException,
    ValidationError,
)

from coil_rl.errors import UserError
from coil_rl.signature import describe, near, shown


def sentence(error: BaseException) -> str:
    """One line for an error that a person can mend."""
    if isinstance(error, UserError):
        return _line(error)
    if isinstance(error, OSError) and not isinstance(error, MissingConfigException):
        return f"{error.filename} cannot be used ({error.strerror}); choose another folder with hydra.run.dir=FOLDER"
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} cannot be read; write KEY=VALUE, a value with special signs as 'KEY=\"VALUE\"'"
    if isinstance(error, MissingConfigException):
        return _missing_file(error)
    if isinstance(error, ConfigCompositionException):
        return _composition(error)
    if isinstance(error, OmegaConfBaseException):
        return _value(error)
    if "Config group override must be" in str(error):
        return "a group takes the name of one of its files, as in guide=spline"
    return _line(error)


def _missing_file(error: MissingConfigException) -> str:
    if error.missing_cfg_file is None:
        return _line(error)
    group, _, name = error.missing_cfg_file.rpartition("/")
    if not group:
        return f"there is no configuration {name!r}; leave out --config-name, or name a file in --config-dir"
    known = sorted(error.options or [])
    if not known:
        return f"there is no {group}={name}, because there is no group {group} in the configuration"
    return f"there is no {group}={name}; {group} can be {', '.join(known)}{near(name, known)}"


def _composition(error: ConfigCompositionException) -> str:
    text, cause = _line(error), error.__cause__
    if isinstance(cause, (ConfigAttributeError, ConfigKeyError, ConfigTypeError, ValidationError)):
        merged = re.match(r"Error merging override \+*([^=]+)=", text)
        return _value(cause, merged[1] if merged else "")
    if several := re.match(r"Ambiguous value for argument '(.*?)' 1\.|Sweep parameters '(.*?)'", text):
        given = several[1] or several[2]
        key, _, values = given.partition("=")
        return f"{given} gives several values; add -m to run one after the other, or write {key}=[{values}] for a list"
    if unlisted := re.match(r"Could not override '(.*?)'\. No match", text):
        return f"nothing is chosen for {unlisted[1]} yet, so that it cannot be replaced; write +{unlisted[1]}=NAME"
    if missing := re.match(r"Could not delete from config\. '(.*?)' does not exist", text):
        return f"there is no key {missing[1]} to remove"
    if chosen := re.match(r"Multiple values for (.*?)\. .*override .*: (.*)'", text):
        return f"{chosen[1]} is chosen already; write {chosen[1]}={chosen[2]} without the +"
    return f"{text}; {_line(cause)}" if cause is not None and _line(cause) not in text else text


def _value(error: OmegaConfBaseException, given: str = "") -> str:
    key, parent = given or str(error.full_key or error.key or ""), error.parent_node
    if isinstance(error, (ConfigAttributeError, ConfigKeyError)):
        known = (
            [str(name) for name in parent if name not in ("hydra", "defaults")]
            if isinstance(parent, DictConfig)
            else []
        )
        inside = key.rpartition(".")[0] or "the configuration"
        add = f"; +{key}=VALUE adds it" if "." in key and "struct" in str(error) else ""
        return f"there is no key {key}; {inside} has {', '.join(known)}{add}{near(str(error.key), known)}"
    if missing := re.search(r"Missing mandatory value: (\S+)", str(error)):
        wanted = missing[1] if "." in missing[1] or not key else key
        return f"{wanted} must be given: write {wanted}=VALUE"
    if isinstance(error, InterpolationKeyError):
        return f"{key} refers to a key that does not exist ({_line(error)})"
    if str(error).startswith("Cannot merge"):
        return f"{key} is a list where a table is wanted, or a table where a list is"
    if isinstance(error, ValidationError) and key and (hint := _declared(error)):
        return f"{key}={shown(error.value)} must be {hint}"
    return f"{key}: {_line(error)}" if key else _line(error)


def _declared(error: OmegaConfBaseException) -> str:
    """What the typed configuration wants at the place of an error, in words; nothing if it is not typed there."""
    try:
        hint = get_type_hints(error.object_type)[str(error.key)]
    except (KeyError, TypeError, NameError):
        hint = getattr(getattr(error.parent_node, "_metadata", None), "element_type", Any)
    if is_dataclass(hint):
        return f"a table with {', '.join(field.name for field in fields(hint))}"
    return "" if hint is Any else describe(hint)


def _line(error: BaseException) -> str:
    lines = str(error).split("\nConfig search path:")[0].split("\nSee http")[0].splitlines()
    return (
        " ".join(line.strip() for line in lines if line.strip() and not re.match(r"\s*(full_key:|\w+_type=)", line))
        or type(error).__name__
    )
