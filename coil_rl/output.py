"""What a program shows while it works: a fault in it must not end the work.

A terminal may be closed, a disk full, and a picture is drawn by the code of an env. The results do
not depend on any of them.
"""

import math
import sys
import textwrap
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from importlib.util import find_spec
from time import time
from typing import Any

from tqdm import tqdm

from coil_rl.errors import NO_SPACE

LINE_EVERY = 60.0  # s, of a progress bar in a file


class SafeStream:
    """A stream that is written to as long as it can be.

    Args:
        stream: such as `sys.stderr`; None for one that is closed.

    Attributes:
        broken: whether it could not be written to.
        full: the error of a full disk, on which a text was lost.
    """

    def __init__(self, stream: Any) -> None:
        self.stream, self.broken = stream, stream is None
        self.full: OSError | None = None

    def write(self, text: str) -> int:
        """Write a text, unless the stream is broken; return its length."""
        self._call("write", text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream, unless it is broken."""
        self._call("flush")

    def isatty(self) -> bool:
        """Return whether the stream is a terminal."""
        return bool(self._call("isatty"))

    def _call(self, name: str, *arguments: Any) -> Any:
        if self.broken:
            return None
        try:
            return getattr(self.stream, name)(*arguments)
        except (OSError, ValueError) as error:  # a ValueError for a closed file
            self.broken = True
            if isinstance(error, OSError) and error.errno in NO_SPACE:
                self.full = error
            return None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def printable(text: str) -> str:
    """Return a text whose control characters, which a terminal obeys, are written as escapes."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


_quiet: ContextVar[str] = ContextVar("quiet", default="")


@contextmanager
def quietly(*, bars: bool = False) -> Iterator[None]:
    """Show neither progress bars nor what is said in the block; warnings and errors stay.

    Args:
        bars: whether bars are shown nevertheless.
    """
    before = _quiet.set("said" if bars and _quiet.get() != "all" else "all")
    try:
        yield
    finally:
        _quiet.reset(before)


class Lines(tqdm):
    """A progress bar in a file: a plain line a minute, and one at the end of a bar that stays."""

    last_print_t = math.inf  # nothing at the beginning

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Write a line if it is due; tqdm ends the last one."""
        if msg is None and (self.disable or time() - self.last_print_t >= self.mininterval):
            self.fp.write(f"{self}{'' if self.disable else chr(10)}")


def progress(**options: Any) -> "tqdm[Any]":
    """Return a progress bar on standard error, or in a notebook.

    `options` are those of tqdm; a file gets plain lines.
    """
    if _quiet.get() == "all":
        options["disable"] = True
    stream = SafeStream(sys.stderr)
    if "ipykernel" not in sys.modules:
        if stream.isatty():
            return tqdm(file=stream, **options)
        return Lines(file=stream, **options | {"mininterval": LINE_EVERY})
    if find_spec("ipywidgets") is not None:
        from tqdm.notebook import tqdm as widget

        return widget(**options)
    # One line for all bars: codes that move a cursor are letters in a notebook.
    return tqdm(file=stream, **options | {"position": 0, "mininterval": 1.0})


def say(text: str, *, error: bool = False) -> None:
    """Print a text.

    Args:
        error: whether to print on standard error.
    """
    if _quiet.get():
        return
    stream = SafeStream(sys.stderr if error else sys.stdout)
    stream.write(f"{text}\n")
    stream.flush()


@contextmanager
def decoration(name: str) -> Iterator[None]:
    """Turn any error in the block into a warning of one sentence.

    Args:
        name: of what is shown, the beginning of the sentence.
    """
    try:
        yield
    except Exception as error:  # whatever a library or an env raises
        reason = textwrap.shorten(f"{type(error).__name__}: {error}", 200, placeholder=" ...")
        text = f"{name} is left out ({reason}); the results are complete without it"
        with suppress(OSError, ValueError):  # standard error is closed
            warnings.warn(text, stacklevel=2)
