"""Docstrings: their examples run, and each argument that a user gives is documented once.

Users give the arguments of what `docs/api.md` shows and of what a `_target_` in a YAML file names.
An argument is documented where it is declared: by the class itself, by a class that it derives
from, or by the typed dictionary of its `**settings`.
"""

import ast
import dataclasses
import doctest
import importlib
import importlib.util
import inspect
import itertools
import pkgutil
import re
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import hydra.utils
import pytest
from programs import CONF, ROOT

import coil_fmu
import coil_paper
import coil_rl
import coil_robot
import coil_studies

MODULES = [
    module.name
    for package in (coil_rl, coil_fmu, coil_paper, coil_robot, coil_studies)
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    if ">>>" in (importlib.util.find_spec(module.name).loader.get_source(module.name) or "")
]
API = (coil_rl, coil_rl.envs, coil_rl.transforms, coil_rl.guides, coil_rl.learners)
FOLDERS = ("coil_rl", "envs", "transforms", "fmu", "paper", "studies", "benchmarks", "docs")
TARGET = re.compile(r"_target_: *(coil_(?:fmu|rl|studies)\.[\w.]+)")
NAME = re.compile(r"    (\*{0,2}\w[\w, *]*):")

Public = Callable[..., Any]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name):
    failures, examples = doctest.testmod(importlib.import_module(name))
    assert examples
    assert not failures


def in_api() -> Iterator[Public]:
    """Yield what `docs/api.md` shows."""
    for package in API:
        for name in getattr(package, "__all__", vars(package)):
            if not name.startswith("_"):
                yield getattr(package, name)


def named_in_yaml() -> Iterator[Public]:
    for file in sorted(CONF.rglob("*.yaml")):
        for name in TARGET.findall(file.read_text(encoding="utf-8")):
            yield hydra.utils.get_object(name)


def public() -> list[Public]:
    """Return the classes and functions of both kinds, but exceptions."""
    found: dict[str, Public] = {}
    for thing in (*in_api(), *named_in_yaml()):
        is_class = inspect.isclass(thing)
        if not (is_class or inspect.isfunction(thing)) or (
            is_class and issubclass(thing, BaseException)
        ):
            continue
        if thing.__module__.startswith(("coil_rl.", "coil_studies.")):
            found[f"{thing.__module__}.{thing.__qualname__}"] = thing
    return [found[name] for name in sorted(found)]


def parameters(thing: Public) -> list[inspect.Parameter]:
    """Return the parameters of a function, or of the constructor of a class."""
    if inspect.isclass(thing):
        if issubclass(thing, tuple):
            function = thing.__new__
        else:
            owner = next(base for base in thing.__mro__ if "__init__" in vars(base))
            if not owner.__module__.startswith(("coil_rl.", "coil_studies.")):
                return []  # it has no constructor of its own
            function = owner.__init__
        return list(inspect.signature(function).parameters.values())[1:]
    return list(inspect.signature(thing).parameters.values())


def documented(thing: Any) -> list[str]:
    """Return the names under `Args:`; for a class of fields, those under `Attributes:` will do."""
    sections = ["Args:"]
    if has_fields(thing):
        sections.append("Attributes:")
    return documented_in(thing.__doc__ or "", sections)


def has_fields(thing: Any) -> bool:
    if dataclasses.is_dataclass(thing) or typing.is_typeddict(thing):
        return True
    return inspect.isclass(thing) and issubclass(thing, tuple)


def documented_in(docstring: str, sections: list[str]) -> list[str]:
    lines = inspect.cleandoc(docstring).splitlines()
    start = next((lines.index(section) for section in sections if section in lines), len(lines))
    names = []
    for line in lines[start + 1 :]:
        if line and not line.startswith(" "):
            break
        name = NAME.match(line)
        if name:
            names += [each.strip().lstrip("*") for each in name[1].split(",")]
    return names


def settings_of(parameter: inspect.Parameter) -> Any:
    """Return the typed dictionary of `**settings: Unpack[...]`, None for another parameter."""
    if typing.get_origin(parameter.annotation) is typing.Unpack:
        return typing.get_args(parameter.annotation)[0]
    return None


def families(thing: Public) -> Iterator[Any]:
    """Yield a function or class and what it takes its documentation from."""
    classes = thing.__mro__ if inspect.isclass(thing) else (thing,)
    for each in classes:
        yield each
        if each is thing or "__init__" in vars(each):
            for settings in filter(None, map(settings_of, parameters(each))):
                yield from typed_dictionaries(settings)


def typed_dictionaries(settings: Any) -> Iterator[Any]:
    yield settings
    for base in getattr(settings, "__orig_bases__", ()):
        if typing.is_typeddict(base):
            yield from typed_dictionaries(base)


def faults(thing: Public) -> Iterator[str]:
    title = f"{thing.__module__}.{thing.__qualname__}"
    own = [each for each in parameters(thing) if settings_of(each) is None]
    for parameter in own:
        if inspect.isclass(thing) and parameter.kind is parameter.VAR_KEYWORD:
            yield f"{title} has **{parameter.name} of no typed dictionary"
    settings = [each for each in map(settings_of, parameters(thing)) if each is not None]
    needed = {each.name for each in own}.union(*(each.__annotations__ for each in settings))
    known = set(itertools.chain(*map(documented, families(thing))))
    if not needed <= known:
        yield f"{title} does not document {sorted(needed - known)}"


@pytest.mark.parametrize("thing", public(), ids=lambda thing: thing.__qualname__)
def test_every_argument_that_a_user_gives_is_documented(thing):
    found = list(faults(thing))
    assert not found, "\n".join(found)


def definitions(folder: str) -> Iterator[tuple[Path, ast.AST]]:
    """Yield all functions and classes of a folder; links to folders are not followed."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        if path.resolve() == path and ".venv" not in path.parts:
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
                    yield path, node


def declared(node: ast.AST) -> set[str]:
    """Return the arguments of a function, or of the constructor of a class, and its fields."""
    if isinstance(node, ast.ClassDef):
        fields = [each.target.id for each in node.body if isinstance(each, ast.AnnAssign)]
        constructors = [each for each in node.body if getattr(each, "name", "") == "__init__"]
        return set(fields).union(*map(declared, constructors))
    return {each.arg for each in ast.walk(node.args) if isinstance(each, ast.arg)}


@pytest.mark.parametrize("folder", FOLDERS)
def test_only_arguments_that_there_are_are_documented(folder):
    wrong = []
    for path, node in definitions(folder):
        names = documented_in(ast.get_docstring(node) or "", ["Args:"])
        if not set(names) <= declared(node):
            wrong.append(f"{path.relative_to(ROOT)}: {node.name}: {set(names) - declared(node)}")
    assert not wrong, "\n".join(wrong)
