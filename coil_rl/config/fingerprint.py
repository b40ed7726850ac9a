"""Fingerprints of a user's objects, equal in every process.

A configuration holds only a name for such an object, so that two of them look the same there. A
fingerprint is the class of an object with a hash of its state: numbers, texts, arrays, and the code
of functions and of classes, but for those of libraries. For an object whose state Python does not
show it is the class alone.
"""

import hashlib
import inspect
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import nn

PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic)
NAMED = (type, ModuleType, BuiltinFunctionType)
INSTALLED = {"site-packages", "dist-packages"}  # folders of libraries


def fingerprint(thing: Any) -> str:
    """Return the class of an object, with a hash of its state where that can be read.

    Args:
        thing: it may be anything.
    """
    title = _name(thing if isinstance(thing, (FunctionType, type)) else type(thing))
    with suppress(Exception):  # code of somebody else, such as a property that raises
        digest = hashlib.sha256()
        for part in _parts(thing, {}):
            digest.update(part + b"\0")
        return f"{title} (state {digest.hexdigest()[:10]})"
    return title


def _name(thing: Any) -> str:
    """Return the qualified name of a class, function or module."""
    name = getattr(thing, "__qualname__", thing.__name__)
    return f"{getattr(thing, '__module__', '')}.{name}".lstrip(".")


def _parts(thing: Any, seen: dict[int, tuple[int, Any]]) -> Iterator[bytes]:
    """Yield bytes that describe the state of an object.

    Args:
        thing: the object.
        seen: what was met, with its number, by its id.
    """
    if isinstance(thing, PLAIN):
        yield repr(thing).encode()
        return
    if id(thing) in seen:
        yield f"number {seen[id(thing)][0]}".encode()
        return
    # Whether two equal constants are one object depends on how they came to be.
    if not isinstance(thing, (tuple, frozenset)):
        seen[id(thing)] = len(seen), thing
    yield _name(type(thing)).encode()
    if isinstance(thing, NAMED):
        yield _name(thing).encode()
        for each in _of_class(thing) if isinstance(thing, type) else ():
            yield from _parts(each, seen)
    elif isinstance(thing, torch.Tensor):
        flat = thing.detach().cpu().contiguous().flatten()
        yield f"{thing.dtype} {list(thing.shape)}".encode()
        yield flat.view(torch.uint8).numpy().tobytes()
    elif isinstance(thing, np.ndarray) and not thing.dtype.hasobject:
        yield f"{thing.dtype} {thing.shape}".encode()
        yield thing.tobytes()
    elif isinstance(thing, (set, frozenset)):
        yield from sorted(b" ".join(_parts(each, dict(seen))) for each in thing)
    else:
        for each in _inside(thing):
            yield from _parts(each, seen)


def _inside(thing: Any) -> list[Any]:
    """Return the parts of the state of an object."""
    if isinstance(thing, Mapping):
        return [each for item in thing.items() for each in item]
    if isinstance(thing, (list, tuple)):
        return list(thing)
    if isinstance(thing, np.ndarray):
        return list(thing.ravel())
    if isinstance(thing, partial):
        return [thing.func, thing.args, thing.keywords]
    if isinstance(thing, MethodType):
        return [thing.__self__, thing.__func__]
    if isinstance(thing, FunctionType):
        outer = inspect.getclosurevars(thing).nonlocals
        return [thing.__code__, thing.__defaults__, thing.__kwdefaults__, outer, _globals(thing)]
    if isinstance(thing, CodeType):
        return [thing.co_code, thing.co_consts, thing.co_names]
    if isinstance(thing, nn.Module):
        return [thing.state_dict(), *map(_settings, thing.modules())]
    return [type(thing), vars(thing)] if hasattr(thing, "__dict__") else [type(thing)]


def _globals(function: FunctionType) -> dict[str, Any]:
    """Return the globals of a user's function that it uses: data, functions, and user's classes.

    Others may be anything, such as a whole experiment.
    """
    known = function.__globals__ if is_of_user(function) else {}
    used = {name: known[name] for name in sorted(_names(function.__code__)) if name in known}
    return {
        name: each
        for name, each in used.items()
        if isinstance(each, (FunctionType, type)) or _is_data(each)
    }


def _names(code: CodeType) -> set[str]:
    """Return the names of globals and attributes in a code, and in the functions within."""
    inner = [_names(each) for each in code.co_consts if isinstance(each, CodeType)]
    return set(code.co_names).union(*inner)


def _is_data(thing: Any) -> bool:
    """Return whether something is a number, a text, an array, or a container of such."""
    if isinstance(thing, Mapping):
        return all(_is_data(each) for item in thing.items() for each in item)
    if isinstance(thing, (list, tuple, set, frozenset)):
        return all(map(_is_data, thing))
    if isinstance(thing, np.ndarray):
        return not thing.dtype.hasobject
    return isinstance(thing, (*PLAIN, torch.Tensor))


def _of_class(thing: type) -> Iterator[Any]:
    """Yield the bases of a user's class, and its code and data with their names."""
    if not is_of_user(thing):
        return
    yield thing.__bases__
    for name, each in vars(thing).items():
        if isinstance(each, (staticmethod, classmethod)):
            yield name, each.__func__
        elif isinstance(each, property):
            yield name, each.fget, each.fset
        elif isinstance(each, cached_property):
            yield name, each.func
        elif isinstance(each, (FunctionType, type)) or (name[:2] != "__" and _is_data(each)):
            yield name, each


def is_of_user(thing: Any) -> bool:
    """Return whether a function or class is neither of Python, of a library nor of this package.

    Args:
        thing: the function or class.
    """
    name = str(getattr(thing, "__module__", ""))
    if name.partition(".")[0] in (*sys.stdlib_module_names, "coil_rl"):
        return False
    file = getattr(sys.modules.get(name), "__file__", None)
    return file is None or not INSTALLED & set(Path(file).parts)


def _settings(module: nn.Module) -> tuple[type, dict[str, Any]]:
    """Return the class of a module, and its plain attributes, such as a gain."""
    plain = {name: each for name, each in vars(module).items() if isinstance(each, PLAIN)}
    plain.pop("training", None)
    return type(module), plain
