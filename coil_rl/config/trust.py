"""The gate for received run folders: what a `config.yaml` can name.

Somebody else may have written it.

Instantiating a configuration calls whatever its `_target_` keys name, and imports what `of` of a
controller and the `id` of a Gymnasium env name as `MODULE:NAME`. So each of them must be on a list
of full names before anything is imported:

- what the shipped configuration names in the groups of a run, also as an alternative in a comment:
  a part that has its YAML file is on the list, unless its line says that it needs `trust=`;
- some transforms of TorchRL, none of which writes a file where the folder says;
- what the configuration of the command itself names, because the command uses it anyway;
- anything that is defined in a package that the user trusts.

The logger of a run is not among them: `shipped_logger` takes it by its name. A constructor
on the list may read a file that its arguments name, but must not write one.
`docs/trust.md` has the trust model.
"""

import re
import sys
from collections.abc import Iterable, Mapping
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from types import ModuleType
from typing import Any

import hydra.utils
import yaml
from omegaconf import DictConfig, OmegaConf

from coil_rl.config.schema import packages, shipped
from coil_rl.errors import UserError, did_you_mean
from coil_rl.plain_yaml import entries

ENTRY_POINTS = (
    "coil_rl.trusted"  # a package with an entry point of its name in this group is trusted
)
# Their functions run any code or write any file.
NEVER_TRUSTED = frozenset(sys.stdlib_module_names) | {
    "coil_rl",
    "hydra",
    "joblib",
    "numpy",
    "omegaconf",
    "pandas",
    "scipy",
    "sympy",
    "tensordict",
    "torch",
}

NAMED = frozenset(
    [
        "coil_rl.config.nodes.kept",  # it looks an object up that the user handed over in Python
        "torchrl.envs.CatFrames",
        "torchrl.envs.ClipTransform",
        "torchrl.envs.DoubleToFloat",
        "torchrl.envs.ObservationNorm",
        "torchrl.envs.RewardClipping",
        "torchrl.envs.RewardScaling",
        "torchrl.envs.StepCounter",
        "torchrl.envs.TimeMaxPool",
        "torchrl.envs.VecNorm",
    ]
)

_packages: frozenset[str] = frozenset()  # of the option `trust`
_own: frozenset[str] = frozenset()  # targets in the configuration of the command
CODE = re.compile(r"[^\W\d][\w.]*:[^\W\d][\w.-]*")  # MODULE:NAME, wherever it is
PLAIN = r"[\w-]+"  # a name that is no path, no address and no reference


def trust_packages(packages: Iterable[str]) -> None:
    """Let the run folders that this process reads from here on use parts of packages.

    They may use parts of no others. A folder may call everything that is defined in these packages.

    Args:
        packages: their top-level names.

    Raises:
        UserError: for a package that is never trusted.
    """
    global _packages, _own
    names = list(packages)
    for name in names:
        if not name.isidentifier():
            raise UserError(
                f"trust=[{name}] must be a list of names of installed packages, such as "
                "trust=[my_package]"
            )
        if name in NEVER_TRUSTED:
            raise UserError(
                f"trust=[{name}] cannot be: functions of {name} run any code; name the package of "
                "the part"
            )
    _packages, _own = frozenset(names), frozenset()


def trust_own(config: DictConfig) -> None:
    """Let the folders that this process reads name what a configuration of the user names."""
    global _own
    _own |= import_paths(config)


def import_paths(config: DictConfig) -> frozenset[str]:
    """Return the import paths in the entries of a configuration, written with points only.

    Args:
        config: the configuration, or a part of it.
    """
    paths = (
        _import_path(name, key, value)
        for name, key, value in entries(OmegaConf.to_container(config), lists=True)
    )
    return frozenset(path for path in paths if isinstance(path, str))


def to_trust(config: DictConfig) -> list[str]:
    """Return the packages that a later command which takes the folder of a run must trust.

    They are those of the option `trust`, and those of parts that are trusted only here, because
    the command itself names them.

    Args:
        config: of the run.
    """
    named = import_paths(
        OmegaConf.masked_copy(config, [str(key) for key in config if key != "logger"])
    )
    packages = {target.partition(".")[0] for target in named - NAMED - _shipped_targets()}
    known = metadata.entry_points(group=ENTRY_POINTS).names
    return sorted(_packages | (packages - NEVER_TRUSTED - known))


def check_config(config: DictConfig, path: Path) -> None:
    """Check a configuration that somebody else may have written.

    Anything that could run code or write elsewhere is a `UserError`.

    Nothing is resolved, and nothing is imported but packages that the user trusts.
    """
    for name, key, value in entries(OmegaConf.to_container(config), lists=True):
        named = (
            key if not name.startswith("defaults[") else ""
        )  # Hydra's list names groups by paths
        if re.search(r"[/\\]", str(value if name == "label" else named)):
            raise UserError(
                f"{path}: {name:.100} must not contain / or \\, because files are named by it"
            )
        target = _import_path(name, key, value)
        if key == "_target_" or target is not None:
            _check_target(target, name, f"{path}: {name:.100} names {target!r:.100}")
        elif str(key).startswith("_") and key != "_partial_":
            raise UserError(f"{path}: {name:.100} is not a key of a run's configuration; remove it")
        # Only a logger is saved with references, and none to itself, so that they cannot grow.
        known = r"(?!)"
        if name.startswith("logger.") and key != "_target_":
            known = r"\$\{(?!logger\b)\w[\w.]*\}"
        if isinstance(value, str) and "${" in re.sub(known, "", value):
            raise UserError(
                f"{path}: {name:.100}={value!r:.100} is a reference; put the value in its place"
            )


def _import_path(name: str, key: Any, value: Any) -> Any:
    """Return what an entry names to be imported, written with points only, else None."""
    if key == "_target_":
        return value
    if not isinstance(value, str):
        return None
    names_code = key == "of" or (key == "id" and ":" in value) or CODE.fullmatch(value)
    return value.replace(":", ".", 1) if names_code else None


def _check_target(target: Any, name: str, entry: str) -> None:
    """Raise a `UserError` if an entry names something that a folder may not call.

    Args:
        target: what it names.
        name: its full key.
        entry: that names it, the beginning of the sentence.
    """
    package = target.partition(".")[0] if isinstance(target, str) else ""
    if not package.isidentifier():
        raise UserError(f"{entry}, which is not the full name of a class; give one")
    allowed = NAMED | _shipped_targets() | _own
    if target in allowed:
        return
    entry_points = metadata.entry_points(group=ENTRY_POINTS).names
    if package not in NEVER_TRUSTED and package in _packages | entry_points:
        # A Gymnasium env is registered by its module, and has no name of its own there.
        if not name.endswith(".id"):
            _check_origin(target, package, entry)
    elif package in NEVER_TRUSTED:
        similar = did_you_mean(target, allowed) if package == "coil_rl" else ""
        raise UserError(
            f"{entry}, which is no part of a run and could run code{similar or '; remove it'}"
        )
    else:
        raise UserError(
            f"{entry}, which could run code; if you know the folder and the package, allow it with "
            f'trust=[{package:.100}] on the command line, or trust=["{package:.100}"] in Python'
        )


def _check_origin(target: str, package: str, entry: str) -> None:
    """Raise a `UserError` if a part is not defined in the trusted package that names it.

    Args:
        entry: that names it, the beginning of the sentence.
    """
    try:
        thing = hydra.utils.get_object(target)
    except Exception as error:
        raise UserError(
            f"{entry}, which {package} does not have; check that the package is installed"
        ) from error
    if not _is_own(thing, target, package):
        raise UserError(f"{entry}, which is defined elsewhere; name the package that defines it")


def _is_own(thing: Any, target: str, package: str) -> bool:
    """Return whether what a package has under a name is its own.

    A class or function says where it is defined. Another object, such as a trained model of a
    library or a `functools.partial`, is its own if a module of the package holds it, and no module
    of another installed package. A method `predict` is judged by its object.
    """
    if str(getattr(thing, "__module__", None)).partition(".")[0] == package:
        return True
    home, _, name = target.rpartition(".")
    if name == "predict":
        return _is_own(hydra.utils.get_object(home), home, package)
    if hasattr(thing, "__qualname__") or isinstance(thing, ModuleType) or home not in sys.modules:
        return False
    holders = {
        module.partition(".")[0]
        for module, content in list(sys.modules.items())
        if any(value is thing for value in list(getattr(content, "__dict__", {}).values()))
    }
    installed = {*sys.stdlib_module_names, *metadata.packages_distributions()}
    return not installed & (holders - {package})


@cache
def _shipped_targets() -> frozenset[str]:
    """Return all targets that the files of coil-rl and of its guests name in their groups.

    Loggers are not among them, because what they write and where is up to their arguments, nor
    what a comment on its line says needs `trust=`: it runs a file that the folder names.
    """
    found: set[str] = set()
    for package in packages():
        for group in resources.files(package).iterdir():
            if group.name in ("hydra", "logger") or not group.is_dir():
                continue
            for file in group.iterdir():
                if ".yaml" in file.name:
                    text = file.read_text(encoding="utf-8")
                    found |= set(re.findall(r"_target_: ([\w.]+)(?!.*trust=)", text))
    return frozenset(found)


def shipped_logger(node: Any) -> dict[str, Any] | None:
    """Return the shipped logger that a configuration names; None if it is none of them.

    Args:
        node: what a folder has as its `logger`.
    """
    target = node.get("_target_") if isinstance(node, Mapping) else None
    for file in shipped("logger").values():
        ours = yaml.safe_load(file.read_text("utf-8"))
        if ours and ours["_target_"] == target:
            plain = {key: node[key] for key in ours if _fits(ours[key], node.get(key))}
            return dict(ours | plain)
    return None


def _fits(shipped: Any, given: Any) -> bool:
    """Return whether a value may take the place of a shipped one: both are names, or both flags."""
    if isinstance(shipped, bool):
        return isinstance(given, bool)
    names = isinstance(shipped, str) and isinstance(given, str)
    return names and all(re.fullmatch(PLAIN, text) for text in (shipped, given))
