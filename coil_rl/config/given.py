"""Objects that a user handed over in Python, as parts of a configuration.

A class or a function of a module is named in the configuration by its import path, as on the
command line. An object without such a path, such as one with a state or a lambda, is kept here, in
this process, and the configuration holds a name for it. A folder with such a name can be opened
again if the object is handed over again.
"""

import sys
from collections.abc import Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from coil_rl.errors import UserError

TARGET = "coil_rl.config.given.kept"
PLACES = {"env": ("env.id", "env.of", "env"), "guide": ("guide.controller.of",)}
_objects: dict[str, Any] = {}  # by the name in a configuration


def keep(name: str, thing: Any) -> dict[str, str]:
    """Keep an object under a name, and return the node of a configuration that stands for it."""
    _objects[name] = thing
    return {"_target_": TARGET, "name": name}


def kept(name: str) -> Any:
    """Return the object that was kept under a name.

    Raises:
        UserError: if it was not handed over in this process.
    """
    if name not in _objects:
        part = name.rpartition("#")[2]
        raise UserError(
            f"this run was made in Python with an object as its {part}, which no import path "
            f"names; open it in Python with coil_rl.open_run(FOLDER, {part}=OBJECT)"
        )
    return _objects[name]


def give(config: DictConfig, objects: Mapping[str, Any]) -> None:
    """Hand over the objects of a configuration again.

    Args:
        config: of a run that was made in Python.
        objects: by "guide" or "env"; None for nothing.

    Raises:
        UserError: for an object that the configuration has no place for.
    """
    for part, thing in objects.items():
        if thing is None:
            continue
        names = _names(config, part)
        if not names:
            raise UserError(f"{part}: the run names its own {part}; leave {part}= out")
        keep(names[0], thing)


def kept_objects(config: DictConfig, part: str) -> list[Any]:
    """Return the Python objects that a configuration names, as they were handed over.

    Args:
        part: "guide" or "env".

    Raises:
        UserError: if one was not handed over in this process.
    """
    return [kept(name) for name in _names(config, part)]


def _names(config: DictConfig, part: str) -> list[str]:
    """Return the names under which objects of a configuration are kept."""
    nodes = [OmegaConf.select(config, place) for place in PLACES[part]]
    return [
        node["name"]
        for node in nodes
        if isinstance(node, DictConfig) and node.get("_target_") == TARGET
    ]


def import_path(thing: Any) -> str | None:
    """Return MODULE:NAME of a class or function that any process can import, else None."""
    module, name = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
    if not isinstance(module, str) or not isinstance(name, str) or module == "__main__":
        return None
    found: Any = sys.modules.get(module)
    for part in name.split("."):
        found = getattr(found, part, None)
    return f"{module}:{name}" if found is thing else None
