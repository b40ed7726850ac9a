"""The rules of style that a formatter and a linter do not check.

Code that breaks a rule hides something from its reader: which of several values is meant, or which
sentence a user sees.
"""

import ast
import inspect
import io
import os
import tokenize
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("envs", "transforms", "coil_rl", "benchmarks", "fmu", "paper", "robot", "studies")
LONGEST_COMPREHENSION = 5  # lines

Comprehension = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
Function = (ast.FunctionDef, ast.AsyncFunctionDef)


def python_files() -> Iterator[Path]:
    """Yield all files; links to folders are not followed, so that each file comes once."""
    for folder in FOLDERS:
        for parent, _, names in os.walk(ROOT / folder, followlinks=False):
            for name in sorted(names):
                if name.endswith(".py"):
                    yield Path(parent, name)


def own_nodes(function: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a function without those of the functions and classes inside it."""
    for child in ast.iter_child_nodes(function):
        if not isinstance(child, (*Function, ast.ClassDef)):
            yield child
            yield from own_nodes(child)


def nested_conditionals(nodes: list[ast.AST], source: str) -> Iterator[int]:
    """A conditional expression inside another one."""
    for outer in nodes:
        if isinstance(outer, ast.IfExp):
            inner = [node for node in ast.walk(outer) if isinstance(node, ast.IfExp)]
            if len(inner) > 1:
                yield outer.lineno


def long_comprehensions(nodes: list[ast.AST], source: str) -> Iterator[int]:
    """A comprehension over more than five lines, or with two `for` over more than one line."""
    for node in nodes:
        if isinstance(node, Comprehension):
            lines = node.end_lineno - node.lineno + 1
            if lines > LONGEST_COMPREHENSION or (lines > 1 and len(node.generators) > 1):
                yield node.lineno


def lets(nodes: list[ast.AST], source: str) -> Iterator[int]:
    """A comprehension over a single value, which gives that value a name."""
    for node in nodes:
        if isinstance(node, ast.comprehension) and isinstance(node.iter, (ast.List, ast.Tuple)):
            elements = node.iter.elts
            if len(elements) == 1 and not isinstance(elements[0], ast.Starred):
                yield node.iter.lineno


def formatter_switches(nodes: list[ast.AST], source: str) -> Iterator[int]:
    """A comment that switches the formatter off."""
    if "fmt:" not in source.replace(" ", ""):
        return
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        text = token.string.replace(" ", "")
        if token.type == tokenize.COMMENT and text.startswith(("#fmt:skip", "#fmt:off")):
            yield token.start[0]


def glued_messages(nodes: list[ast.AST], source: str) -> Iterator[int]:
    """A message of an exception or a warning that is put together from texts with names.

    Nobody can search the code for such a sentence.
    """
    for function in nodes:
        if isinstance(function, Function):
            texts = texts_with_names(function)
            for message in messages(function):
                if is_glued(message, texts):
                    yield message.lineno


def texts_with_names(function: ast.AST) -> set[str]:
    """Return the names that are assigned once in a function, namely a literal text."""
    assigned = Counter[str]()
    texts = set()
    for node in own_nodes(function):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            assigned[node.id] += 1
        if isinstance(node, ast.Assign):
            for target in node.targets:
                texts |= names_of_texts(target, node.value)
    return {name for name in texts if assigned[name] == 1}


def names_of_texts(target: ast.expr, value: ast.expr) -> set[str]:
    """Return the names to which an assignment, of one value or of several, gives a literal text."""
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        pairs = zip(target.elts, value.elts, strict=False)
        return set().union(*(names_of_texts(*pair) for pair in pairs))
    if isinstance(target, ast.Name) and is_text(value):
        return {target.id}
    return set()


def is_text(node: ast.AST) -> bool:
    literal = isinstance(node, ast.Constant) and isinstance(node.value, str)
    return literal or isinstance(node, ast.JoinedStr)


def messages(function: ast.AST) -> Iterator[ast.expr]:
    """Yield the first argument of each exception that a function raises, and of each warning."""
    for node in own_nodes(function):
        call = node.exc if isinstance(node, ast.Raise) else node
        if not isinstance(call, ast.Call) or not call.args:
            continue
        if isinstance(node, ast.Raise) or ast.unparse(call.func) == "warnings.warn":
            yield call.args[0]


def is_glued(message: ast.expr, texts: set[str]) -> bool:
    if isinstance(message, ast.BinOp):
        parts = [node for node in ast.walk(message) if isinstance(node, (ast.Name, ast.Attribute))]
        return isinstance(message.op, ast.Add) and bool(parts)
    if not isinstance(message, ast.JoinedStr):
        return False
    placeholders = [node.value for node in message.values if isinstance(node, ast.FormattedValue)]
    return any(isinstance(value, ast.Name) and value.id in texts for value in placeholders)


RULES: tuple[Callable[[list[ast.AST], str], Iterator[int]], ...] = (
    nested_conditionals,
    long_comprehensions,
    lets,
    formatter_switches,
    glued_messages,
)


def parsed(source: str) -> tuple[list[ast.AST], str]:
    """Return what a rule reads: the nodes of a file, and its text."""
    return list(ast.walk(ast.parse(source))), source


@cache
def sources() -> dict[Path, tuple[list[ast.AST], str]]:
    return {file: parsed(file.read_text(encoding="utf-8")) for file in python_files()}


@pytest.mark.parametrize("rule", RULES)
def test_code_keeps_the_rules_of_style(rule):
    places = [
        f"{file.relative_to(ROOT)}:{line}"
        for file, source in sources().items()
        for line in sorted(set(rule(*source)))
    ]
    assert not places, "\n".join([inspect.getdoc(rule), *places])


@pytest.mark.parametrize(
    ("rule", "code"),
    [
        (nested_conditionals, "x = a if b else c if d else e"),
        (long_comprehensions, "x = [\n    a\n    for b in c\n    for a in b\n]"),
        (lets, "x = [y + y for y in [f(z)]]"),
        (formatter_switches, "x = [1,2]  # fmt: skip"),
        (glued_messages, "def f(a):\n    b, c = f'{a} is none', 1\n    raise E(f'{b}; give one')"),
        (glued_messages, "def f(a):\n    raise E(a + '; give one')"),
        (glued_messages, "def f(a):\n    warnings.warn(a.b + '; give one')"),
    ],
)
def test_a_rule_finds_what_breaks_it(rule, code):
    assert list(rule(*parsed(code)))
