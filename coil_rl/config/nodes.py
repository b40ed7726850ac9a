"""Instantiation of nodes with a `_target_`, after a check of their arguments.

This is the only caller of Hydra's `instantiate`.
"""

import textwrap
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import hydra.utils
from omegaconf import DictConfig, ListConfig, OmegaConf
from torchrl.envs import Transform

from coil_rl.config.arguments import check_arguments, converted
from coil_rl.errors import UserError
from coil_rl.ranges import yaml_text

# Largest numbers of arguments of other libraries, by class: memory grows with them, and the
# libraries do not check them.
LARGEST_ARGUMENTS = {
    ("CatFrames", "N"): 1000,
    ("TimeMaxPool", "T"): 1000,
}


def build(node: Any, name: str, expected: type | None = None, **arguments: Any) -> Any:
    """Instantiate a node of the configuration, and the nodes inside it.

    Their arguments are checked first.

    A target that does not exist, refuses an argument, or returns another type is a `UserError`.

    Args:
        node: with a `_target_`.
        name: key of the node, for the message.
        expected: type of the result.
        arguments: added by the program.
    """
    node = _converted(check_node(node, name, arguments))
    try:
        # In the node, because Hydra merges it with keyword arguments, which takes a while.
        built = hydra.utils.instantiate({**node, "_convert_": "all"}, **arguments)
    except hydra.errors.InstantiationException as error:
        cause = error.__cause__
        if isinstance(cause, (UserError, ValueError, KeyError, TypeError, AttributeError, OSError)):
            message = cause.args[0] if isinstance(cause, KeyError) and cause.args else cause
            raise UserError(
                f"{name}: {textwrap.shorten(str(message), 500, placeholder=' ...')}"
            ) from error
        if isinstance(cause, ImportError):
            raise UserError(
                f"{name}: {node['_target_']} needs a package ({cause}); install it"
            ) from error
        if cause is None:  # Hydra itself refuses to call the target
            raise UserError(f"{name}: {error}") from error
        if isinstance(cause, MemoryError) or "allocate" in str(cause):
            raise UserError(f"{name}: there is not enough memory; make it smaller") from error
        raise
    if expected is not None and not isinstance(built, expected):
        raise UserError(
            f"{name}: {node['_target_']} makes {type(built).__name__}, not {expected.__name__}"
        )
    return built


def check_node(node: Any, name: str, program: Iterable[str] = ()) -> dict[str, Any]:
    """Return a node with its references resolved, after the checks of `build`.

    Nothing is built.

    `program` has the names of the arguments that the program adds.
    """
    if isinstance(node, (DictConfig, ListConfig)):
        node = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    if not isinstance(node, Mapping) or "_target_" not in node:
        raise UserError(
            f"{name}={yaml_text(node)} has no _target_; give it one, the full name of a class or "
            "function"
        )
    _check(node, name, program)
    return dict(node)


def _check(node: Any, name: str, program: Iterable[str] = ()) -> None:
    if isinstance(node, Mapping):
        for key, value in node.items():
            _check(value, f"{name}.{key}")
        if "_target_" in node:
            target = find_target(node["_target_"], name)
            check_arguments(target, node, name, program)
            _check_size(target, node, name)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _check(value, f"{name}[{index}]")


def _check_size(target: Callable[..., Any], node: Mapping[str, Any], name: str) -> None:
    """Raise a `UserError` for an argument of another library that memory cannot hold."""
    for key, value in node.items():
        largest = LARGEST_ARGUMENTS.get((getattr(target, "__name__", ""), key))
        if largest is not None and isinstance(value, int) and value > largest:
            raise UserError(
                f"{name}.{key}={yaml_text(value)} must be at most {largest}: memory grows with it"
            )


def _converted(node: Any) -> Any:
    """Return a checked node with nodes for the tuples and arrays that callables of others want."""
    if isinstance(node, list):
        return [_converted(value) for value in node]
    if not isinstance(node, Mapping):
        return node
    node = {key: _converted(value) for key, value in node.items()}
    if "_target_" not in node:
        return node
    return converted(hydra.utils.get_object(node["_target_"]), node)


def find_target(path: Any, name: str) -> Callable[..., Any]:
    """Return the class or function of a full name.

    `name` is the key that names it, for the message.
    """
    try:
        target: Callable[..., Any] = hydra.utils.get_object(path)
    except UserError as error:  # an extra is missing
        raise UserError(f"{name}: {error}") from error
    except Exception as error:
        raise UserError(
            f"{name}: there is no {path!r}; check the spelling, and that its package is installed"
        ) from error
    if not callable(target):
        raise UserError(
            f"{name}: {path} is {target!r}, which cannot be called; give a class or a function"
        )
    return target


def build_all(nodes: Mapping[str, Any], name: str) -> list[Transform]:
    """Return transforms in the order of the configuration."""
    return [build(node, f"{name}.{key}", Transform) for key, node in nodes.items()]
