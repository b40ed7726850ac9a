"""One sentence for an error of the user, of Hydra or of OmegaConf."""

import errno
from pathlib import Path

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, MissingMandatoryValue, OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationKeyError,
    OmegaConfBaseException,
)

from coil_rl.errors import IN_THE_WAY, NO_SPACE, UserError, did_you_mean

LAUNCHERS = {
    "joblib": "joblib",
    "submitit_slurm": "slurm",
    "submitit_local": "slurm",
    "ray": "ray",
}  # and their extras


def is_no_bug(error: BaseException) -> bool:
    """Return whether an error has a cause outside of the program: the input, the configuration or the disk."""
    outside = isinstance(error, (UserError, OmegaConfBaseException))
    return outside or getattr(error, "errno", None) in (*NO_SPACE, *IN_THE_WAY)


def sentence(error: BaseException) -> str:
    """Return the message of an error of the user, of Hydra or of OmegaConf on one line."""
    return " ".join(_message(error).split())


def _message(error: BaseException) -> str:
    cause = error.__cause__
    if isinstance(error, UserError):
        return str(error)
    if isinstance(error, MissingConfigException):
        return _unknown_file(error)
    if isinstance(error, OSError):
        name, remedy = (
            error.filename or "the output",
            "choose another folder with hydra.run.dir=FOLDER",
        )
        if error.errno == errno.ENAMETOOLONG:
            name, remedy = f"{Path(name).name[:60]}...", "choose a shorter name"
        elif error.errno in IN_THE_WAY:
            remedy = "put the right file or folder there, with the right to use it"
        return f"{name} cannot be used ({error.strerror}); {remedy}"
    if isinstance(
        error, (AssertionError, TypeError)
    ):  # of Hydra, for a choice of a group that is no text
        return (
            "the command line cannot be composed; give each group a name, GROUP=CHOICE (see --help)"
        )
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} cannot be parsed; write KEY=VALUE, and quote special characters: 'KEY=\"VALUE\"'"
    for key_error in (error, cause):
        if isinstance(key_error, (ConfigAttributeError, ConfigKeyError)):
            return _unknown_key(key_error)
    if isinstance(error, MissingMandatoryValue) and error.full_key:
        return f"{error.full_key} must be given: write {error.full_key}=VALUE"
    if isinstance(error, OmegaConfBaseException) and (key := error.full_key):
        if isinstance(error, InterpolationKeyError):
            missing, group = str(error).split("'")[1], key.partition(".")[0]
            return f"{key} refers to {missing}, which does not exist; choose another {group}, or give {key}=VALUE"
        return f"{key}: {_first_paragraph(error)}"
    if isinstance(cause, OmegaConfBaseException):
        return f"{_first_paragraph(error)}: {_first_paragraph(cause)}"
    return _first_paragraph(error)


def _unknown_file(error: MissingConfigException) -> str:
    group, _, name = (error.missing_cfg_file or "").rpartition("/")
    if not group:
        return _first_paragraph(error)
    if group == "hydra/launcher" and name in LAUNCHERS:
        return f"hydra/launcher={name} is not installed: python -m pip install 'coil-rl[{LAUNCHERS[name]}]'"
    options = sorted(error.options or [])
    choices = (
        f"; {group} can be {', '.join(options)}{did_you_mean(name, options)}" if options else ""
    )
    return f"there is no {group}={name}{choices}"


def _unknown_key(error: OmegaConfBaseException) -> str:
    key, parent = str(error.full_key or error.key), error.parent_node
    names = parent if isinstance(parent, DictConfig) else []
    known = [str(name) for name in names if name not in ("hydra", "defaults")]
    node = key.rpartition(".")[0] or "the configuration"
    add = (
        f"; +{key}=VALUE adds it"
        if parent is not None and OmegaConf.get_type(parent) is dict
        else ""
    )
    return f"there is no key {key}; {node} has {', '.join(known) or 'none'}{add}{did_you_mean(str(error.key), known)}"


def _first_paragraph(error: BaseException) -> str:
    # Indented lines hold OmegaConf's internals.
    lines = str(error).partition("\n\n")[0].splitlines()
    kept = [
        line.strip()
        for line in lines
        if line.strip() and not line.startswith((" ", "\t", "See http"))
    ]
    return " ".join(kept) or type(error).__name__
