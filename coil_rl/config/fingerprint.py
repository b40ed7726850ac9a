"""Fingerprints of the objects of a user, which are the same in every process.

A configuration holds only a name for such an object, so that two of them look the same there. A
fingerprint is the class of an object with a hash of its state: numbers, texts, arrays, and the code
of functions. For an object whose state Python does not show it is the class alone.
"""

import hashlib
import inspect
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import nn

PLAIN = (bool, int, float, complex, str, bytes, type(None), np.generic)
NAMED = (type, ModuleType, BuiltinFunctionType)


def fingerprint(thing: Any) -> str:
    """Return the class of an object, with a hash of its state where that can be read.

    Args:
        thing: it may be anything.
    """
    title = _name(thing if isinstance(thing, FunctionType) else type(thing))
    with suppress(Exception):  # code of somebody else, such as a property that raises
        digest = hashlib.sha256()
        for part in _parts(thing, {}):
            digest.update(part + b"\0")
        return f"{title} (state {digest.hexdigest()[:10]})"
    return title


def fingerprint_with_code(thing: Any) -> str:
    """Return a fingerprint that differs after a change in the code of the class, too.

    Args:
        thing: a class, a function or an object.
    """
    kind = thing if isinstance(thing, type) else type(thing)
    code = {}
    for each in kind.__mro__:
        if each.__module__ == kind.__module__:  # other modules are libraries, as a rule
            code[each.__name__] = [*map(_behind, vars(each).items())]
    return fingerprint([thing, code])


def _behind(item: tuple[str, Any]) -> tuple[str, Any]:
    """Return the name and the function or plain value of an attribute of a class."""
    name, value = item
    value = getattr(value, "__func__", getattr(value, "fget", value))
    own = isinstance(value, (*PLAIN, FunctionType)) and name != "__firstlineno__"
    return name, value if own else None


def _name(thing: Any) -> str:
    """Return the qualified name of a class, function or module."""
    name = getattr(thing, "__qualname__", thing.__name__)
    return f"{getattr(thing, '__module__', '')}.{name}".lstrip(".")


def _parts(thing: Any, seen: dict[int, tuple[int, Any]]) -> Iterator[bytes]:
    """Yield the state of an object.

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
    # Whether two equal tuples are one object depends on how they came to be.
    if not isinstance(thing, tuple):
        seen[id(thing)] = len(seen), thing
    yield _name(type(thing)).encode()
    if isinstance(thing, NAMED):
        yield _name(thing).encode()
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
        outer = inspect.getclosurevars(thing)
        named = (*PLAIN, FunctionType)  # other globals may be anything, such as a whole experiment
        used = {name: each for name, each in outer.globals.items() if isinstance(each, named)}
        return [thing.__code__, thing.__defaults__, thing.__kwdefaults__, outer.nonlocals, used]
    if isinstance(thing, CodeType):
        return [thing.co_code, thing.co_consts, thing.co_names]
    if isinstance(thing, nn.Module):
        return [thing.state_dict(), *map(_settings, thing.modules())]
    return [vars(thing)] if hasattr(thing, "__dict__") else []


def _settings(module: nn.Module) -> tuple[type, dict[str, Any]]:
    """Return the class of a module, and what it holds besides weights and what a call leaves."""
    plain = {name: each for name, each in vars(module).items() if isinstance(each, PLAIN)}
    plain.pop("training", None)
    return type(module), plain
