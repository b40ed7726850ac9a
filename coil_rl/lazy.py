"""Names of a package that are imported on first use.

Its `__init__.py` imports them for type checkers only, and for everybody else asks for these three:

    if TYPE_CHECKING:
        from my_package.module import Name as Name
    else:
        __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
"""

import ast
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazy_names(
    package: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package.

    Args:
        package: its name.
        file: its `__init__.py`, whose `from MODULE import NAME as NAME` are read.
    """
    modules: dict[str, str] = {}
    for node in ast.walk(ast.parse(Path(file).read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = {alias.name for alias in node.names if alias.name == alias.asname}
            modules |= dict.fromkeys(names, node.module)

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if modules[name] == package:  # a module of it
            return importlib.import_module(f"{package}.{name}")
        return getattr(importlib.import_module(modules[name]), name)

    return get, lambda: sorted(modules), sorted(modules)
