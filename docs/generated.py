"""What the pages need not say themselves: help texts, YAML files, extras and the public API.

Each directive of this file reads it where it is defined, at every build.
"""

import importlib
import inspect
import itertools
import re
import tomllib
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import coil_rl

ROOT = Path(__file__).parents[1]
# Folders with YAML files: of the library, and of the guests whose files Hydra finds beside them.
CONFS = (ROOT / "conf", ROOT / "robot" / "conf", ROOT / "studies" / "conf")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Headings of the API, by the beginning of the module that defines a name; the first that fits.
PARTS = {
    "Runs": ("coil_rl.run", "coil_rl.config", "coil_rl.comparison", "coil_rl.measures"),
    "Envs": ("coil_rl.envs", "coil_rl.foreign.gymnasium_env", "coil_rl.foreign.torchrl_env"),
    "Transforms": ("coil_rl.transforms",),
    "Guides": ("coil_rl.guides", "coil_rl.foreign", "coil_rl.cones"),
    "Learners": ("coil_rl.learners", "coil_rl.imitation"),
    "Checks of your own parts": ("coil_rl.testing",),
    "Other": ("coil_rl",),
}
# Packages whose names are public too: what a YAML file of your own may name.
PACKAGES = ("coil_rl.envs", "coil_rl.transforms", "coil_rl.guides", "coil_rl.learners")

MARKUP = re.compile(r"(?<=[\[(,\s])\*(?=[\w.])|\|")


class Generated(SphinxDirective):
    """A directive whose content is Markdown that it writes itself."""

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return the nodes of the text; its headings become sections of the page."""
        lines = StringList(list(self.lines()), source=f"{self.env.docname} (generated)")
        node = nodes.section()
        node.document = self.state.document
        self.state.nested_parse(lines, self.content_offset, node, match_titles=True)
        return node.children

    def lines(self) -> Iterator[str]:
        """Yield the lines of the text."""
        raise NotImplementedError


class Commands(Generated):
    """All programs, with what they say about themselves: the header of their `--help`."""

    def lines(self) -> Iterator[str]:
        """Yield a heading and a block of code for each."""
        for program in PROJECT["scripts"]:
            yield from (f"## {program}", "", "```text", *help_of(program).splitlines(), "```", "")


class Programs(Generated):
    """The files of the configuration that programs begin with."""

    def lines(self) -> Iterator[str]:
        """Yield each as a block of code."""
        files = (file for conf in CONFS for file in conf.glob("*.yaml"))
        for file in sorted(files, key=lambda file: file.name):
            if "hydra" in yaml.safe_load(file.read_text()):
                yield from (f"### coil-{file.stem}", "", *block(file))


class Groups(Generated):
    """The groups of the configuration: a table of the choices of each, and then their files."""

    def lines(self) -> Iterator[str]:
        """Yield a section for each group."""
        groups = {file.parent.name for conf in CONFS for file in conf.glob("*/*.yaml")}
        for group in sorted(groups):
            found = (file for conf in CONFS for file in (conf / group).glob("*.yaml"))
            files = sorted(found, key=lambda file: file.name)
            yield from (f"## {group}", "", "| choice | what it is |", "| --- | --- |")
            for file in files:
                yield f"| `{file.stem}` | {escaped(description(file))} |"
            yield ""
            for file in files:
                yield from block(file)


class Extras(Generated):
    """The extras of the package, with what they install."""

    def lines(self) -> Iterator[str]:
        """Yield a table."""
        yield from ("| extra | installs |", "| --- | --- |")
        for name, needs in PROJECT["optional-dependencies"].items():
            cells = ", ".join(f"`{need}`" for need in needs)
            yield f"| `{name}` | {cells} |"


class PublicNames(Generated):
    """All public names, by the part of the library that defines them."""

    def lines(self) -> Iterator[str]:
        """Yield headings and autodoc directives."""
        left = {name: getattr(coil_rl, name) for name in coil_rl.__all__}
        for heading, modules in PARTS.items():
            found = [name for name, thing in left.items() if is_of(thing, modules)]
            yield from (f"## {heading}", "")
            for name in found:
                yield from documented("coil_rl", name, left.pop(name))


class PackageNames(Generated):
    """The public names of a package that `coil_rl` itself does not export."""

    def lines(self) -> Iterator[str]:
        """Yield autodoc directives."""
        package = importlib.import_module(self.arguments[0])
        for name, thing in sorted(vars(package).items()):
            is_public = not name.startswith("_") and not inspect.ismodule(thing)
            if is_public and name not in coil_rl.__all__ and is_of(thing, ("coil_rl",)):
                yield from documented(package.__name__, name, thing)


def help_of(program: str) -> str:
    """Return the header of the help of a program; its docstring if it has no configuration."""
    module = PROJECT["scripts"][program].partition(":")[0]
    file = Path(program.removeprefix("coil-")).with_suffix(".yaml")
    for folder in (*CONFS, ROOT / "paper" / "conf"):
        if (folder / file).is_file():
            return str(yaml.safe_load((folder / file).read_text())["hydra"]["help"]["header"])
    return inspect.cleandoc(importlib.import_module(module).__doc__ or "")


def description(file: Path) -> str:
    """Return the first sentence of the comment at the beginning of a YAML file."""
    comments = []
    for line in file.read_text().splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            comments.append(line.lstrip("# "))
    text = " ".join(comments)
    return re.split(r"(?<=[.:;])\s", text)[0].rstrip(":;.") if text else ""


def block(file: Path) -> Iterator[str]:
    """Yield a YAML file as a block of code, with its name."""
    yield from ("```{code-block} yaml", f":caption: {file.relative_to(ROOT)}", "")
    yield from file.read_text().splitlines()
    yield from ("```", "")


def documented(module: str, name: str, thing: object) -> Iterator[str]:
    """Yield the autodoc directive of a public name."""
    kind = "data"
    if inspect.isclass(thing):
        kind = "exception" if issubclass(thing, Exception) else "class"
    elif callable(thing):
        kind = "function"
    yield from ("```{eval-rst}", f".. auto{kind}:: {module}.{name}", "```", "")


def is_of(thing: object, modules: tuple[str, ...]) -> bool:
    """Return whether something is defined in one of some modules, or below.

    Args:
        thing: class, function or value.
    """
    module = getattr(thing, "__module__", "coil_rl")
    return any(module == each or module.startswith(f"{each}.") for each in modules)


def escaped(text: str) -> str:
    """Return a text as it stands in a cell of a table."""
    return text.replace("|", "\\|").replace("*", "\\*").replace("[", "\\[")


def own_signature(
    app: Sphinx,
    what: str,
    name: str,
    thing: Any,
    options: Any,
    signature: str | None,
    returns: str | None,
) -> tuple[str, str | None] | None:
    """Return the signature of a class by its constructor.

    TorchRL's metaclass shows every env as `(*args, **kwargs)`, and tensordict's `__new__` every
    module.
    """
    if what != "class" or not inspect.isfunction(thing.__init__):
        return None
    from sphinx.util.inspect import signature as signature_of
    from sphinx.util.inspect import stringify_signature

    text = stringify_signature(
        signature_of(thing.__init__, bound_method=True),
        show_return_annotation=False,
        unqualified_typehints=True,
    )
    return text, returns


def plain_docstring(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Escape what a docstring means as it stands: the shape [*batch], the size |a|, a colon."""
    for index, line in enumerate(lines):
        if index and lines[index - 1].strip() == "Returns:":
            # What is before the first colon would be taken for a type.
            lines[index] = line = re.sub(r"^( *)", r"\1: ", line)
        if not line.lstrip().startswith((">>>", "...")):
            parts = line.split("`")  # every second one is code
            parts[::2] = [MARKUP.sub(r"\\\g<0>", part) for part in parts[::2]]
            lines[index] = re.sub(r"(?<=\w)`(?=s\b)", r"`\\ ", "`".join(parts))  # a plural: `Run`s


def arguments_of_bases(
    app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Add the arguments that a class takes and that a class above it documents."""
    if what != "class" or not inspect.isfunction(thing.__init__):
        return
    known, names = entries(lines), taken(thing)
    added: list[str] = []
    for base in thing.__mro__[1:]:
        above = entries(inspect.cleandoc(vars(base).get("__doc__") or "").splitlines())
        for argument in above:
            if argument in names and argument not in known:
                known[argument] = above[argument]
                added += above[argument]
    if added and "Args:" not in lines:
        lines += ["", "Args:", *added]
    elif added:
        end = lines.index("Args:") + 1
        while end < len(lines) and lines[end]:
            end += 1
        lines[end:end] = added


def entries(lines: list[str]) -> dict[str, list[str]]:
    """Return the lines of each entry under `Args:`."""
    found: dict[str, list[str]] = {}
    start = lines.index("Args:") + 1 if "Args:" in lines else len(lines)
    for line in itertools.takewhile(bool, lines[start:]):
        if not line.startswith(" " * 8):
            found[line.strip().partition(":")[0]] = []
        found[next(reversed(found))].append(line)
    return found


def taken(thing: Any) -> set[str]:
    """Return the names of the arguments of a class, those of its typed dictionaries too."""
    names = set[str]()
    for parameter in inspect.signature(thing.__init__).parameters.values():
        settings = typing.get_args(parameter.annotation)
        if typing.get_origin(parameter.annotation) is typing.Unpack:
            names |= settings[0].__annotations__.keys()
        names.add(parameter.name)
    return names


def is_field(
    app: Sphinx, what: str, name: str, thing: object, is_skipped: bool, options: Any
) -> bool | None:
    """Leave out the fields of named tuples, which the docstring of their class describes."""
    return True if type(thing).__name__ == "_tuplegetter" else None


def keep_present(app: Sphinx, page: str, source: list[str]) -> None:
    """Leave out those patterns of the index that no page of this checkout fits."""
    if page != app.config.root_doc:
        return
    folder = ROOT / Path(page).parent
    lines = source[0].splitlines()
    fits = [not line.endswith("*") or any(folder.glob(line)) for line in lines]
    source[0] = "\n".join(line for line, keep in zip(lines, fits, strict=True) if keep)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    directives: dict[str, type[Generated]] = {
        "commands": Commands,
        "extras": Extras,
        "groups": Groups,
        "package-names": PackageNames,
        "programs": Programs,
        "public-names": PublicNames,
    }
    for name, directive in directives.items():
        app.add_directive(name, directive)
    app.connect("autodoc-process-docstring", arguments_of_bases, priority=50)
    app.connect("autodoc-process-docstring", plain_docstring, priority=100)  # before napoleon
    app.connect("autodoc-process-signature", own_signature)
    app.connect("autodoc-skip-member", is_field)
    app.connect("source-read", keep_present)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
