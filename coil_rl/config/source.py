"""What a run depends on of a user's code: the file that defines a part, and the state of an object.

A configuration holds only a name for them, so that two of them look the same there.
"""

import hashlib
import inspect
import io
import pickle
import sys
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

import hydra.utils
from omegaconf import DictConfig, OmegaConf
from torch import Tensor, nn

from coil_rl.config.compose import packages
from coil_rl.config.given import PLACES, kept_objects
from coil_rl.config.trust import import_paths
from coil_rl.errors import UserError
from coil_rl.foreign.host import is_of_user
from coil_rl.plain_yaml import entries

# Parts of a configuration on which the numbers of a run depend, besides its evaluation.
PARTS = ["env", "training", "guide", "method", "learner", "degrade", "disturb", "action"]


def identity_of(thing: Any) -> str:
    """Return the name of a class, function or object, with a hash that is equal in every process.

    It is of the files that define it and its bases, and of the state of an object, if that can be
    pickled: its numbers, texts and arrays, and what a function without a name has closed over.

    Args:
        thing: it may be anything.
    """
    defined = thing if isinstance(thing, (type, FunctionType)) else type(thing)
    inner = getattr(thing, "func", getattr(thing, "__func__", None))  # of a partial, of a method
    digest = hashlib.sha256()
    for part in (*getattr(defined, "__mro__", [defined]), inner):
        if part is not None and is_of_user(part):
            with suppress(OSError, TypeError):  # no file defines it
                digest.update("".join(inspect.findsource(part)[0]).encode())
    state = io.BytesIO()
    with suppress(Exception):  # whatever the pickling of somebody else's object raises
        _State(state).dump(thing)
        digest.update(state.getvalue())
    return f"{defined.__module__}.{defined.__qualname__} (state {digest.hexdigest()[:10]})"


class _State(pickle.Pickler):
    """Pickles what the actions of an object depend on; it is not to be read again."""

    def reducer_override(self, thing: Any) -> Any:
        """Replace what cannot be pickled, or is not the same in each process, by plain values."""
        if isinstance(thing, Tensor):
            return str, (str(thing.dtype), thing.detach().cpu().tolist())
        if isinstance(thing, nn.Module):  # it is used in one mode or the other
            state = [item for item in vars(thing).items() if item[0] != "training"]
            return dict, (type(thing), state)
        if isinstance(thing, type) and is_of_user(thing):
            return str, (f"{thing.__module__}.{thing.__qualname__}",)
        if isinstance(thing, FunctionType) and is_of_user(thing):
            closed = [cell.cell_contents for cell in thing.__closure__ or ()]
            code = thing.__code__
            return list, (thing.__qualname__, code.co_firstlineno, code.co_code, closed)
        return NotImplemented


def code_of_user(config: DictConfig, keys: Iterable[str]) -> list[str]:
    """Return the identity of each class and function of the user that a configuration names.

    Args:
        keys: parts of it to look at, among them `env`, whose id may be registered with Gymnasium.
    """
    parts = OmegaConf.masked_copy(config, list(keys))
    named = [*map(_named, sorted(import_paths(parts))), _registered(config.env.get("id"))]
    found = [identity_of(each) for each in named if each is not None and is_of_user(each)]
    return [*found, *_files_of(parts).values()]


def code_of_run(config: DictConfig) -> dict[str, str]:
    """Return the SHA-256 of each file of the user that a run depends on, by its module.

    They are those that define its parts, what these use of other files of the user, and what its
    configuration names as a `file`, by its name.

    Args:
        config: of the run.
    """
    parts = OmegaConf.masked_copy(config, PARTS)
    parts.evaluation = {key: config.evaluation.get(key) for key in ("env", "advice", "cases")}
    things = [*map(_named, import_paths(parts)), _registered(config.env.get("id"))]
    for place in PLACES:
        with suppress(UserError):  # an object that was not handed over
            things += kept_objects(config, place)
    waiting = [name for thing in things for name in _modules_of(thing)]
    found: dict[str, str] = {}
    ours = {package.partition(".")[0] for package in packages()}
    for name in waiting:  # it grows
        module = sys.modules.get(name)
        file = getattr(module, "__file__", None)
        if name in found or file is None or name.partition(".")[0] in ours:
            continue
        if not is_of_user(SimpleNamespace(__module__=name)):
            continue
        with suppress(OSError):  # it is gone
            found[name] = hashlib.sha256(Path(file).read_bytes()).hexdigest()
            waiting += [each for value in vars(module).values() for each in _modules_of(value)]
    return dict(sorted((found | _files_of(parts)).items()))


def _files_of(parts: DictConfig) -> dict[str, str]:
    """Return the SHA-256 of each `file` that a configuration names, by its name."""
    named = entries(OmegaConf.to_container(parts), lists=True)
    paths = {Path(value) for _, key, value in named if key == "file" and isinstance(value, str)}
    found = {}
    for path in paths:
        with suppress(OSError):  # what is missing is said where it is read
            found[path.name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _modules_of(thing: Any) -> list[str]:
    """Return the names of the modules that define a thing: a module, class, function or object."""
    if isinstance(thing, ModuleType):
        return [thing.__name__]
    thing = getattr(thing, "func", thing)  # of a partial
    defined = thing if isinstance(thing, (type, FunctionType)) else type(thing)
    return [str(each.__module__) for each in getattr(defined, "__mro__", [defined])]


def _named(path: str) -> Any:
    """Return what an import path names; None for nothing, which is refused where it is built.

    Args:
        path: written with points only.
    """
    with suppress(Exception):
        return hydra.utils.get_object(path)
    return None


def _registered(id: Any) -> Any:
    """Return what makes an env that is registered with Gymnasium; None for another one.

    Args:
        id: of the env; it may be anything.
    """
    if isinstance(id, str):
        with suppress(Exception):
            from coil_rl.foreign.makers import registered_maker

            return registered_maker(id)
    return None
