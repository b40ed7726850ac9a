"""Sentences of pages: each page has one file of them, whose macros take values and say them."""

import re
from collections.abc import Iterable, Mapping
from functools import cached_property
from importlib import resources
from typing import Any

from coil_rl.report.table import return_format

MOST = 3  # names in a sentence


class Sentences:
    """The sentences of a page, macros of Jinja that are called by their names.

    In a template the filters `number`, `returns` and `listed` write a number, returns by name, and
    the first of many texts.

    Args:
        package: that has the file.
        file: its name.

    Example:
        >>> page = Sentences("coil_rl.report", "report.j2")
        >>> page.said("progress", finished=3, started=3, refused=0, unstarted=0)
        ['All 3 runs that were started are finished.']
    """

    def __init__(self, package: str, file: str) -> None:
        self.package, self.file = package, file

    def said(self, macro: str, /, **values: Any) -> list[str]:
        """Return the paragraphs of a macro, none if it says nothing."""
        text = str(getattr(self._macros, macro)(**values))
        paragraphs = (" ".join(part.split()) for part in re.split(r"\n\s*\n", text))
        return [part for part in paragraphs if part]

    @cached_property
    def _macros(self) -> Any:
        from jinja2 import Environment, StrictUndefined  # a training reads no page

        environment = Environment(undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
        environment.filters |= {"number": format, "returns": returns, "listed": listed}
        text = (resources.files(self.package) / self.file).read_text("utf-8")
        return environment.from_string(text).module


def returns(values: Mapping[str, float]) -> str:
    """Return named returns as a text, in one number format."""
    spec = return_format(values.values())
    return ", ".join(f"{name} {value:{spec}}" for name, value in values.items())


def listed(texts: Iterable[object], most: int = MOST, joint: str = ", ") -> str:
    """Return texts as one, the first ones of many.

    Args:
        most: number of the texts that are shown; a single further one is shown, too.
        joint: between them.
    """
    shown = [str(text) for text in texts]
    if len(shown) <= most + 1:
        return joint.join(shown)
    return f"{joint.join(shown[:most])} and {len(shown) - most} more"


REPORT = Sentences("coil_rl.report", "report.j2")
