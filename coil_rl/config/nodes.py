"""What a node with a `_target_` names: checked, built, and identified.

This is the only caller of Hydra's `instantiate`.

A class or a function of a module that a user handed over in Python is named in the configuration by
its import path, as on the command line. An object without such a path, such as one with a state or
a lambda, is kept here, in this process, and the configuration holds a name for it. A folder with
such a name can be opened again if the object is handed over again.

What a run depends on of a user's code is the file that defines a part, and the state of an object.
"""

import hashlib
import inspect
import io
import pickle
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from numbers import Number
from pathlib import Path
from types import FunctionType, ModuleType, NoneType, SimpleNamespace, UnionType
from typing import Any, Union, get_args, get_origin

import hydra.utils
import numpy as np
from omegaconf import DictConfig, ListConfig, OmegaConf
from pydantic import ValidationError
from pydantic.errors import PydanticUserError
from pydantic_core import SchemaError
from torch import Tensor, nn
from torchrl.envs import Transform

from coil_rl.config.messages import UnknownArgumentError, similar
from coil_rl.config.schema import packages
from coil_rl.config.trust import import_paths
from coil_rl.errors import UserError
from coil_rl.foreign.host import is_of_user
from coil_rl.plain_yaml import entries
from coil_rl.ranges import adapter, settings_of, validation_message, yaml_text

PLAIN = (bool, int, float, str, NoneType)
HOLDERS = (np.ndarray, tuple, list, Sequence)  # of numbers, in annotations
_TARGET = object()
TARGET = "coil_rl.config.nodes.kept"
PLACES = {"env": ("env.id", "env.of", "env"), "guide": ("guide.controller.of",)}
_objects: dict[str, Any] = {}  # by the name in a configuration
# Parts of a configuration on which the numbers of a run depend, besides its evaluation.
PARTS = ["env", "training", "guide", "method", "learner", "degrade", "disturb", "action"]


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
    node = check_node(node, name, arguments)
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
        raise
    if expected is not None and not isinstance(built, expected):
        raise UserError(
            f"{name}: {node['_target_']} makes {type(built).__name__}, not {expected.__name__}"
        )
    return built


def check_node(node: Any, name: str, program: Iterable[str] = ()) -> dict[str, Any]:
    """Return a node with its references resolved, as it is built, after the checks of `build`.

    Nothing is built.

    `program` has the names of the arguments that the program adds.
    """
    if isinstance(node, (DictConfig, ListConfig)):
        node = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    if not isinstance(node, Mapping) or "_target_" not in node:
        raise UserError(
            f"{name}={yaml_text(node)} has no _target_; give single settings, {name}.KEY=VALUE, or "
            "a _target_, the full name of a class or function"
        )
    return dict(_checked(node, name, program))


def _checked(node: Any, name: str, program: Iterable[str] = ()) -> Any:
    """Return a value as it is built, after the checks of the nodes inside it."""
    if isinstance(node, list):
        return [_checked(value, f"{name}[{index}]") for index, value in enumerate(node)]
    if not isinstance(node, Mapping):
        return node
    node = {key: _checked(value, f"{name}.{key}") for key, value in node.items()}
    if "_target_" not in node:
        return node
    return check_arguments(find_target(node["_target_"], name), node, name, program)


def find_target(path: Any, name: str) -> Callable[..., Any]:
    """Return the class or function of a full name.

    `name` is the key that names it, for the message.
    """
    try:
        target: Callable[..., Any] = hydra.utils.get_object(path)
    except UserError as error:  # an extra is missing
        raise UserError(f"{name}: {error}") from error
    except Exception as error:
        cause, parts = error.__cause__ or error, str(path).split(".")
        if isinstance(cause, ImportError | AttributeError) and _is_named(cause, parts):
            raise UserError(
                f"{name}: there is no {path!r}; check the spelling, and that its package is "
                "installed"
            ) from error
        raise UserError(
            f"{name}: {path} cannot be imported ({type(cause).__name__}: "
            f"{textwrap.shorten(str(cause), 200, placeholder=' ...')}); mend what it needs"
        ) from error
    if not callable(target):
        raise UserError(
            f"{name}: {path} is {target!r}, which cannot be called; give a class or a function"
        )
    return target


def _is_named(error: ImportError | AttributeError, parts: Sequence[str]) -> bool:
    """Return whether an error is about a part of a full name, not about what is behind it."""
    missing = str(error.name or parts[-1]).split(".")
    return list(parts[: len(missing)]) == missing or (len(missing) == 1 and missing[0] in parts)


def build_all(nodes: Mapping[str, Any], name: str) -> list[Transform]:
    """Return transforms in the order of the configuration."""
    return [build(node, f"{name}.{key}", Transform) for key, node in nodes.items()]


def check_arguments(
    target: Callable[..., Any], node: Mapping[str, Any], name: str, program: Iterable[str] = ()
) -> dict[str, Any]:
    """Check the arguments of a node, and return it as it is built.

    An unknown or missing argument, or one that does not fit its annotation, is a `UserError`.

    Annotations of other people are often stricter than their code, and YAML has neither tuples nor
    arrays. So their callables are given any numbers where the annotation is of numbers, arrays or
    sequences, with nodes for the tuples and arrays.

    Args:
        target: class or function.
        node: arguments; `_target_` and `_partial_` are ignored.
        name: key of the node, for the message.
        program: names of the arguments that the program adds.
    """
    title, built = getattr(target, "__name__", str(target)), dict(node)
    given = {key: value for key, value in node.items() if key not in ("_target_", "_partial_")}
    for key in sorted(given.keys() & set(program)):
        raise UserError(f"{name}: {key} of {title} is set by the program; leave it out")
    parameters = _parameters(target)
    if parameters is None:
        return built
    known = {p.name: p for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
    accepts_any = any(p.kind is p.VAR_KEYWORD for p in parameters)
    for key in sorted(given.keys() - known):
        if not accepts_any or key.startswith("_"):
            takes = ", ".join(known) or "nothing"
            raise UnknownArgumentError(
                f"{name}: {title} takes no {key}; it takes {takes}{similar(key, known)}",
                f"{name}.{key}",
            )
    missing = [
        key for key, p in known.items() if p.default is p.empty and key not in {*given, *program}
    ]
    if missing and "_partial_" not in node:
        raise UserError(
            f"{name}: {title} needs {', '.join(missing)}; give {name}.{missing[0]}=VALUE"
        )
    for key in given.keys() & known:
        annotation = known[key].annotation
        if is_foreign(target) and _may_take(given[key], annotation):
            built[key] = _held(given[key], _kinds(annotation))
        else:
            _check_type(given[key], annotation, f"{name}.{key}")
    return built


def is_foreign(target: Callable[..., Any]) -> bool:
    """Return whether a class or function is not of this project."""
    return not (getattr(target, "__module__", None) or "").startswith("coil_rl.")


def _held(numbers: Any, kinds: set[type]) -> Any:
    """Return numbers from YAML, or the node of what holds them where an annotation wants another.

    Args:
        kinds: classes of the annotation.
    """
    if not isinstance(numbers, list) or kinds & {list, Sequence}:
        return numbers
    for kind, maker in ((tuple, "builtins.tuple"), (np.ndarray, "numpy.array")):
        if kind in kinds:
            return {"_target_": maker, "_args_": [numbers]}
    return numbers


def _holds_numbers(value: Any) -> bool:
    """Return whether a value is a finite number, or a nested list of such."""
    if isinstance(value, list):
        return all(map(_holds_numbers, value))
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 2**63


def _may_take(value: Any, annotation: Any) -> bool:
    """Return whether the code behind an annotation of numbers may take a value from YAML."""
    kinds = _kinds(annotation) - {bool, int, str, bytes}
    wanted = HOLDERS if isinstance(value, list) else (Number, np.generic, *HOLDERS)
    return _holds_numbers(value) and any(issubclass(kind, wanted) for kind in kinds)


def _kinds(annotation: Any) -> set[type]:
    """Return the classes of an annotation, those of a union one by one."""
    if get_origin(annotation) in (Union, UnionType):
        return {kind for part in get_args(annotation) for kind in _kinds(part)}
    kind = get_origin(annotation) or annotation
    return {kind} if isinstance(kind, type) else set()


def _check_type(value: Any, annotation: Any, name: str) -> None:
    if annotation is inspect.Parameter.empty or isinstance(annotation, str):
        return
    try:
        allowed = adapter(annotation)
    except (PydanticUserError, SchemaError):  # an annotation that cannot be checked
        return
    if (known := _known(value, list)) is _TARGET:
        if all(part in PLAIN for part in get_args(annotation) or [annotation]):
            raise UserError(f"{name} must be a plain value, not a node with _target_")
        return
    try:
        allowed.validate_python(known)
    except ValidationError as error:
        try:  # strict pydantic accepts no list for a tuple, and YAML has no tuples
            allowed.validate_python(_known(value, tuple))
        except ValidationError:
            raise UserError(validation_message(error, known, name)) from None
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise UserError(f"{name}={value} must be an integer of 64 bits")


def _known(value: Any, sequence: type[list[Any]] | type[tuple[Any, ...]]) -> Any:
    """Return a value without the nodes inside it that have a `_target_`.

    Their results are not known yet.
    """
    if isinstance(value, Mapping):
        entries = {key: _known(entry, sequence) for key, entry in value.items()}
        return (
            _TARGET
            if "_target_" in value
            else {k: entry for k, entry in entries.items() if entry is not _TARGET}
        )
    if isinstance(value, list):
        return sequence(
            entry for entry in (_known(entry, sequence) for entry in value) if entry is not _TARGET
        )
    return value


def _parameters(target: Callable[..., Any]) -> list[inspect.Parameter] | None:
    """Return the parameters of a target.

    They include those that a class passes on to its base class: one of this project, or one that
    says which by `Unpack`.
    """
    has_init = inspect.isclass(target) and target.__init__ is not object.__init__
    try:
        # The signature of a class with a metaclass, such as an env of TorchRL, is that of the
        # metaclass.
        own = list(_signature(target.__init__ if has_init else target).parameters.values())[
            has_init:
        ]
    except ValueError:  # builtins without a signature
        return None
    passes_on = has_init and (
        "__init__" not in vars(target) or any(p.kind is p.VAR_KEYWORD for p in own)
    )
    settings = [known for p in own if (known := settings_of(p)) is not None]
    if not inspect.isclass(target) or not passes_on or (is_foreign(target) and not settings):
        return own
    base = _parameters(target.__bases__[0])
    if base is None:
        return own
    names = {parameter.name for parameter in own}
    return [p for p in own if p.kind is not p.VAR_KEYWORD] + [
        p for p in base if p.name not in names and all(p.name in known for known in settings)
    ]


def _signature(function: Callable[..., Any]) -> inspect.Signature:
    try:
        return inspect.signature(function, eval_str=True)
    except (NameError, TypeError):  # annotations that only a type checker can resolve
        return inspect.signature(function)


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
    for _, key, value in entries(OmegaConf.to_container(parts), lists=True):
        if key == "file" and isinstance(value, str):
            with suppress(OSError):  # what is missing is said where it is read
                found[Path(value).name] = hashlib.sha256(Path(value).read_bytes()).hexdigest()
    return dict(sorted(found.items()))


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
