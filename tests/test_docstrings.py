"""Docstrings: their examples run, and they document exactly the arguments that there are.

A room is a package of `coil_rl`, or `coil_rl` itself. Public is what a room exports and what a
`_target_` in a YAML file names.
"""

import dataclasses
import doctest
import importlib
import importlib.util
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator
from typing import Any

import hydra.utils
import pytest
from programs import CONF

import coil_paper
import coil_rl
import coil_studies

MODULES = [
    module.name
    for package in (coil_rl, coil_paper, coil_studies)
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    if ">>>" in (importlib.util.find_spec(module.name).loader.get_source(module.name) or "")
]
TARGET = re.compile(r"_target_: *(coil_(?:rl|studies)\.[\w.]+)")
NAME = re.compile(r"    (\*{0,2}\w[\w, ]*):")

Public = Callable[..., Any]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name):
    failures, examples = doctest.testmod(importlib.import_module(name))
    assert examples
    assert not failures


def room_of(thing: Public) -> str:
    """Return the package that holds a class or function, `coil_rl` if it is in none."""
    parts = thing.__module__.split(".")
    in_package = len(parts) > 2 or hasattr(importlib.import_module(thing.__module__), "__path__")
    return parts[1] if in_package else parts[0]


def exported() -> Iterator[Public]:
    """Yield the classes and functions that the packages and the library itself export."""
    for name in coil_rl.__all__:
        yield getattr(coil_rl, name)
    for module in pkgutil.iter_modules(coil_rl.__path__, "coil_rl."):
        if module.ispkg:
            for name, thing in vars(importlib.import_module(module.name)).items():
                if not name.startswith("_"):
                    yield thing


def named_in_yaml() -> Iterator[Public]:
    for file in sorted(CONF.rglob("*.yaml")):
        for name in TARGET.findall(file.read_text(encoding="utf-8")):
            yield hydra.utils.get_object(name)


def public() -> list[Public]:
    """Return all public classes and functions of the project, but exceptions."""
    found: dict[str, Public] = {}
    for thing in (*exported(), *named_in_yaml()):
        is_class = inspect.isclass(thing)
        if not (is_class or inspect.isfunction(thing)) or (
            is_class and issubclass(thing, BaseException)
        ):
            continue
        if thing.__module__.startswith("coil_rl."):
            found[f"{thing.__module__}.{thing.__qualname__}"] = thing
    return [found[name] for name in sorted(found)]


def parameters(thing: Public) -> list[inspect.Parameter]:
    """Return the parameters of a function, or of the constructor of a class."""
    if inspect.isclass(thing):
        if issubclass(thing, tuple):
            function = thing.__new__
        else:
            owner = next(base for base in thing.__mro__ if "__init__" in vars(base))
            if not owner.__module__.startswith("coil_rl."):
                return []  # it has no constructor of its own
            function = owner.__init__
        return list(inspect.signature(function).parameters.values())[1:]
    return list(inspect.signature(thing).parameters.values())


def documented(thing: Public) -> list[str]:
    """Return the names under `Args:`; for a class of fields, those under `Attributes:` will do."""
    sections = ["Args:"]
    if dataclasses.is_dataclass(thing) or (inspect.isclass(thing) and issubclass(thing, tuple)):
        sections.append("Attributes:")
    lines = inspect.cleandoc(thing.__doc__ or "").splitlines()
    start = next((lines.index(section) for section in sections if section in lines), len(lines))
    names = []
    for line in lines[start + 1 :]:
        if line and not line.startswith(" "):
            break
        name = NAME.match(line)
        if name:
            names.append(name[1].lstrip("*"))
    return names


def faults(thing: Public) -> Iterator[str]:
    title = f"{thing.__module__}.{thing.__qualname__}"
    for parameter in parameters(thing):
        if inspect.isclass(thing) and parameter.kind is parameter.VAR_KEYWORD:
            yield f"{title} has **{parameter.name}; spell the arguments out"
    names = [parameter.name for parameter in parameters(thing)]
    if documented(thing) != names:
        yield f"{title} documents {documented(thing)}, but takes {names}"


ROOMS = sorted({room_of(thing) for thing in public()})


@pytest.mark.parametrize("room", ROOMS)
def test_public_classes_and_functions_document_their_arguments(room):
    in_room = [thing for thing in public() if room_of(thing) == room]
    found = [fault for thing in in_room for fault in faults(thing)]
    assert in_room
    assert not found, "\n".join(found)
