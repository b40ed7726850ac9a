"""Whether the keys and values of a configuration fit what a function or class says it takes."""

from __future__ import annotations

import difflib
import inspect
import os
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from coil_rl.errors import UserError

WORDS = {
    float: "a finite number",
    int: "a whole number",
    bool: "true or false",
    str: "text",
    NoneType: "null",
    os.PathLike: "a path",
}
LISTS = (list, tuple, Sequence, Iterable)
TABLES = (dict, Mapping)


def check_call(called: Callable[..., Any], node: Mapping[str, Any], name: str, given: Iterable[str] = ()) -> None:
    """Refuse a call before it is made.

    Args:
        called: what is to be called; where it has no annotations its values are not checked.
        node: its arguments, those that begin with an underscore being Hydra's.
        name: what a person calls this node, for the message.
        given: arguments that the program adds.

    Raises:
        UserError: for a key it does not take, one that it needs and does not get, or a value of another type.
    """
    keys = {key for key in node if key not in ("_target_", "_partial_")}
    title = getattr(called, "__name__", str(called))
    for key in sorted(keys.intersection(given)):
        raise UserError(f"{name}: {key} of {title} is set by the program; leave it out")
    parameters = _parameters(called)
    if parameters is None:
        return
    known = takes(called)
    anything = any(p.kind is p.VAR_KEYWORD for p in parameters)
    for key in sorted(keys.difference(known)):
        if not anything or key.startswith("_"):
            raise UserError(
                f"{name}: {title} takes no {key}; it takes {', '.join(known) or 'nothing'}{near(key, known)}"
            )
    lacks = [p.name for p in parameters if p.default is p.empty and p.name in known and p.name not in {*keys, *given}]
    if lacks and "_partial_" not in node:
        raise UserError(f"{name}: {title} needs {', '.join(lacks)}; give {name}.{lacks[0]}=VALUE")
    hints = _hints(called)
    for key in keys.intersection(hints):
        if not fits(node[key], hints[key]):
            path, value, hint = _narrowed(key, node[key], hints[key])
            raise UserError(f"{name}: {path}={shown(value)} must be {describe(hint)}")


def takes(called: Callable[..., Any]) -> list[str]:
    """The names of the arguments of what is called, as far as it tells."""
    return [p.name for p in _parameters(called) or () if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]


def near(given: str, known: Iterable[str]) -> str:
    """`; did you mean X?` for the most similar of what is known, if there is one."""
    similar = difflib.get_close_matches(given, list(known), n=1)
    return f"; did you mean {similar[0]}?" if similar else ""


def fits(value: Any, hint: Any) -> bool:
    """Whether a value of a configuration can be an argument so annotated; what YAML cannot hold is let through."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if isinstance(value, Mapping) and "_target_" in value:
        return True  # what it makes is known only once it is made
    if kind in (Union, UnionType):
        return any(fits(value, option) for option in inner)
    if kind is Literal:
        return any(value == choice and type(value) is type(choice) for choice in inner)
    if kind in (int, float):
        number = isinstance(value, (int, kind)) and not isinstance(value, bool)
        return number and (-(2**63) <= value < 2**63 if kind is int else abs(value) <= sys.float_info.max)
    if kind in (bool, str, NoneType):
        return isinstance(value, kind)
    if kind in LISTS:
        return isinstance(value, (list, tuple)) and all(fits(v, inner[0]) for v in value if _uniform(inner))
    if kind in TABLES:
        return isinstance(value, Mapping) and all(fits(v, inner[1]) for v in value.values() if inner)
    if kind in (Callable, os.PathLike):
        return False
    # Our own annotations are exact, those of others may mean more than they say.
    return not (inspect.isclass(kind) and kind.__module__.startswith("coil_rl.")) or isinstance(value, kind)


def describe(hint: Any) -> str:
    """An annotation in words."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return " or ".join(dict.fromkeys(describe(option) for option in inner))
    if kind is Literal:
        return "one of " + ", ".join(map(str, inner))
    if kind in LISTS:
        return f"a list, each entry {describe(inner[0])}" if _uniform(inner) and inner[0] is not Any else "a list"
    if kind in TABLES:
        return f"a table, each value {describe(inner[1])}" if inner and inner[1] is not Any else "a table"
    if inspect.isclass(kind) and issubclass(kind, Enum):
        return "one of " + ", ".join(kind.__members__)
    return WORDS.get(kind, "made by a _target_" if kind is Callable else f"a {getattr(kind, '__name__', kind)}")


def shown(value: Any) -> str:
    """A value as it stands in YAML and on the command line."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    return textwrap.shorten(repr(value), 100, placeholder=" ...")


def _uniform(inner: tuple[Any, ...]) -> bool:
    return len(inner) == 1 or (len(inner) == 2 and inner[1] is Ellipsis)


def _narrowed(path: str, value: Any, hint: Any) -> tuple[str, Any, Any]:
    """The entry of a list or table that is the one at fault, so that the message need not repeat all of it."""
    for option in get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,):
        kind, inner = get_origin(option) or option, get_args(option)
        for key, entry in value.items() if kind in TABLES and isinstance(value, Mapping) and inner else ():
            if not fits(entry, inner[1]):
                return _narrowed(f"{path}.{key}", entry, inner[1])
    return path, value, hint


def _parameters(called: Callable[..., Any]) -> list[inspect.Parameter] | None:
    """What is called takes, as far as it tells; what a class of ours hands on, its base takes."""
    try:
        # Of a class with a metaclass that can be called, as TorchRL's envs, `signature` sees the metaclass only.
        if inspect.isclass(called) and called.__init__ is not object.__init__:
            own = list(inspect.signature(called.__init__).parameters.values())[1:]
            if _hands_on(called) and (rest := _parameters(called.__bases__[0])) is not None:
                names = {parameter.name for parameter in own}
                own = [p for p in own if p.kind is not p.VAR_KEYWORD] + [p for p in rest if p.name not in names]
            return own
        return list(inspect.signature(called).parameters.values())
    except ValueError:
        return None


def _hands_on(called: type) -> bool:
    parameters = inspect.signature(vars(called).get("__init__", called)).parameters.values()
    return called.__module__.startswith("coil_rl.") and any(p.kind is p.VAR_KEYWORD for p in parameters)


def _hints(called: Any) -> dict[str, Any]:
    try:
        own = get_type_hints(called.__init__ if inspect.isclass(called) else called)
        if inspect.isclass(called) and _hands_on(called):
            return _hints(called.__bases__[0]) | own
        return own
    except (AttributeError, NameError, TypeError):  # annotations that only a type checker can resolve
        return {}
