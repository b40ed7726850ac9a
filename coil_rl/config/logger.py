"""The logger of a run that goes on: by its name, from the shipped configuration.

A logger may write anywhere and send to any address. So of a folder, which may be somebody else's,
only the class of a shipped logger is taken, with plain names and flags, such as the project.
"""

import re
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

import yaml

from coil_rl.config.nodes import build
from coil_rl.errors import UserError
from coil_rl.extras import require

# The packages of TorchRL's loggers, which are extras of this one.
PACKAGES = {
    "MLFlowLogger": "mlflow",
    "TensorboardLogger": "tensorboard",
    "TrackioLogger": "trackio",
    "WandbLogger": "wandb",
}
PLAIN = r"[\w-]+"  # a name that is no path, no address and no reference


def shipped_logger(node: Any) -> dict[str, Any] | None:
    """Return the shipped logger that a configuration names; None if it is none of them.

    Args:
        node: what a folder has as its `logger`.
    """
    target = node.get("_target_") if isinstance(node, Mapping) else None
    for shipped in _shipped_loggers():
        if shipped["_target_"] == target:
            plain = {key: node[key] for key in shipped if _fits(shipped[key], node.get(key))}
            return shipped | plain
    return None


def _fits(shipped: Any, given: Any) -> bool:
    """Return whether a value may take the place of a shipped one: both are names, or both flags."""
    if isinstance(shipped, bool):
        return isinstance(given, bool)
    names = isinstance(shipped, str) and isinstance(given, str)
    return names and all(re.fullmatch(PLAIN, text) for text in (shipped, given))


def check_logger(node: Mapping[str, Any]) -> None:
    """Check that the package of a logger is installed, before a run is begun.

    Args:
        node: of the logger.

    Raises:
        UserError: if it is missing.
    """
    package = PACKAGES.get(str(node["_target_"]).rpartition(".")[2])
    if package is not None:
        require("this logger (logger=none needs no package)", package, package)


def make_logger(node: Any) -> Any:
    """Return the logger of a run.

    Args:
        node: of the logger.

    Raises:
        UserError: for whatever the logger raises, such as without a log-in or a server.
    """
    try:
        return build(node, "logger")
    except UserError:
        raise
    except Exception as error:
        reason = " ".join(str(error.__cause__ or error).split())[:300]
        raise UserError(
            f"logger: {node['_target_']} could not be started ({reason}); correct the cause, or "
            "take logger=none"
        ) from error


@cache
def _shipped_loggers() -> list[dict[str, Any]]:
    """Return the loggers in `conf/logger`."""
    files = (resources.files("coil_rl.conf") / "logger").iterdir()
    texts = [file.read_text("utf-8") for file in files if file.name.endswith(".yaml")]
    return [node for node in map(yaml.safe_load, texts) if node]
