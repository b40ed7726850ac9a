"""What code of other people returns, checked before anything computes with it, at every step.

A fault in it is one sentence that names the env or the controller, the row, the seed of the episode
and the step, and says what came and what was expected.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray


class ForeignError(ValueError):
    """A fault in an env or controller of somebody else, as one sentence."""

    outside: ClassVar[bool] = True  # the cause is not in this program


class FaultError(ForeignError):
    """One without its place, which `foreign` adds."""


@contextmanager
def foreign(name: str, call: str) -> Iterator[None]:
    """Turn what the code of somebody else raises, and a `FaultError`, into a `ForeignError`.

    Args:
        name: of the env or controller, as in "the env Plant", and where it is.
        call: what it was asked, such as "step".
    """
    try:
        yield
    except FaultError as error:
        raise ForeignError(f"{name}: {error}") from error.__cause__
    except (ForeignError, KeyboardInterrupt):
        raise
    except BaseException as error:  # also what a library derives from it
        # A tail such as ": " without a text would say nothing.
        text = shortened(str(error)) or "without a text"
        raise ForeignError(f"{name}: {call} raised {type(error).__name__}: {text}") from error


def shortened(text: str, most: int = 200) -> str:
    """Return a text on one line, of at most so many characters."""
    line = " ".join(text.split())
    return line if len(line) <= most else f"{line[:most].rstrip()} ..."


def shown(value: Any) -> str:
    """Return in a few words what code of other people has returned."""
    try:
        if hasattr(value, "dtype") and math.prod(value.shape) > 8:
            return f"an array of the shape {list(value.shape)} ({value.dtype})"
        text = repr(value.tolist() if hasattr(value, "tolist") else value)
    except Exception:  # a `__repr__` of other people may fail, too
        text = f"an object of {type(value).__name__}"
    return shortened(text, 80)


def plain_array(value: Any, what: str) -> NDArray[Any]:
    """Return numbers as an array.

    Args:
        value: a number, a nested list of numbers, an array or a tensor.
        what: name of the value, for the message.

    Raises:
        FaultError: for anything else.
    """
    if type(value) is np.ndarray and value.dtype.kind in "biuf":
        return value
    with suppress(Exception):
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
        if array.dtype.kind in "biuf" and not np.ma.is_masked(value):
            return array
    raise FaultError(f"{what} is {shown(value)}, not an array of numbers")


def one_number(value: Any, what: str) -> float:
    """Return one number.

    Args:
        what: name of the number, for the message.

    Raises:
        FaultError: for None, a text, an array with a dimension, and a complex number.
    """
    with suppress(Exception):
        if not isinstance(value, (str, bytes)) and np.ndim(value) == 0:
            return float(value)
    raise FaultError(f"{what} is {shown(value)}, not one number")


def flag(value: Any, what: str) -> bool:
    """Return a flag.

    Args:
        what: name of the flag, for the message.

    Raises:
        FaultError: for anything but True, False, 1 and 0.
    """
    single = np.ndim(value) == 0 and not isinstance(value, (str, bytes))
    if not single or value is None or value not in (0, 1):
        raise FaultError(f"{what} is {shown(value)}, not True or False")
    return bool(value)


def action_array(value: Any) -> NDArray[Any]:
    """Return an action of a controller as an array of at least one dimension.

    Raises:
        FaultError: for what is not numbers, or not finite; also for an action with a state, as
            controllers of some libraries return them.
    """
    if isinstance(value, tuple) and any(np.ndim(part) or part is None for part in value[:2]):
        raise FaultError(
            f"the action is the tuple {shown(value)}; return the action alone, without a state"
        )
    array = np.atleast_1d(plain_array(value, "the action"))
    if array.dtype == np.bool_:
        array = array.astype(np.int64)
    if not np.isfinite(array).all():
        raise FaultError(f"the action is {shown(array)}, which is not finite")
    return array
