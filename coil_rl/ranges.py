"""Ranges and choices of arguments: annotations, checked where something is made.

`Annotated[float, Gt(0)]` is a range and `Literal["a", "b"]` a choice. pydantic checks them, for
YAML before anything is built, and in Python by `checked`. Anything of the project may import this
file, and importing it costs nothing: pydantic is imported at the first check.
"""

import inspect
import textwrap
from collections.abc import Callable, Iterable, Mapping
from functools import cache, wraps
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_origin

from annotated_types import Ge as Ge
from annotated_types import Gt as Gt
from annotated_types import Interval as Interval
from annotated_types import Le as Le
from annotated_types import Len as Len

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

Finite = Annotated[float, Interval()]
Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
Share = Annotated[float, Interval(ge=0, le=1)]
Count = Annotated[int, Ge(1)]
Index = Annotated[int, Ge(0)]
Seed = Annotated[int, Interval(ge=0, le=2**63 - 1)]
Processes = Literal["auto"] | Annotated[int, Interval(ge=0, le=256)]
# Of worlds with cones: laps, seconds and starts of an episode, visible cones of a side (two make a
# curve), and the largest steering.
Laps = Annotated[int, Interval(gt=0, le=10**6)]
Seconds = Annotated[float, Interval(gt=0, le=10**6)]
Starts = Annotated[int, Interval(ge=1, le=10**5)]
SeenCones = Annotated[int, Ge(2)]
Degrees = Annotated[float, Interval(gt=0, le=90)]

# What is said of pydantic's errors; of others its own words.
WORDS = {
    "greater_than": "more than {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "sequence_str": "a list",
    "too_long": "at most {max_length} long",
    "too_short": "at least {min_length} long",
}

Part = TypeVar("Part", bound=Callable[..., Any])


def checked(part: Part) -> Part:
    """Check the arguments of a function, or of the constructor of a class, at each call.

    Checked are arguments with a range or a choice in their annotation. One that does not fit is a
    `ValueError` that names it, what was given and what is allowed. A schedule is checked at both
    ends of the run. Where `**settings: Unpack[Settings]` says which arguments of its base class a
    constructor takes, another one is a `TypeError`.

    Args:
        part: class or function; a class, perhaps a dataclass, is changed in place.

    Returns:
        The class, or the function that checks.

    Example:
        >>> @checked
        ... def wait(seconds: Positive = 1.0) -> None: ...
        >>> wait(0)
        Traceback (most recent call last):
        ValueError: seconds=0 must be more than 0
    """
    if not isinstance(part, type):
        return _checking(part, part.__name__)
    part.__init__ = _checking(part.__init__, part.__name__)  # type: ignore[misc]
    return part


def _checking(function: Any, title: str) -> Any:
    """Return a function that checks its arguments; `title` is its name in messages."""

    @cache  # not before the first call, because pydantic takes a while
    def bounds() -> tuple[inspect.Signature, dict[str, "TypeAdapter[Any]"], dict[str, set[str]]]:
        signature = inspect.signature(function, eval_str=True)
        annotations = {name: each.annotation for name, each in signature.parameters.items()}
        adapters = {name: adapter(each) for name, each in annotations.items() if bounded(each)}
        settings = {name: settings_of(each) for name, each in signature.parameters.items()}
        return signature, adapters, {k: each for k, each in settings.items() if each is not None}

    @wraps(function)
    def call(*given: Any, **named: Any) -> Any:
        signature, adapters, settings = bounds()
        arguments = signature.bind(*given, **named).arguments
        for name, known in settings.items():
            if unknown := set(arguments.get(name, ())) - known:
                raise TypeError(f"{title} takes no {', '.join(sorted(unknown))}")
        for name, allowed in adapters.items():
            if name in arguments:
                _check(name, arguments[name], allowed)
        return function(*given, **named)

    return call


def settings_of(parameter: inspect.Parameter) -> set[str] | None:
    """Return the arguments that `**settings: Unpack[Settings]` stands for; None for others."""
    if parameter.kind is not parameter.VAR_KEYWORD:
        return None
    (settings,) = get_args(parameter.annotation) or [None]
    return set(settings.__annotations__) if hasattr(settings, "__total__") else None


def bounded(annotation: Any) -> bool:
    """Return whether an annotation has a range or a choice in it."""
    if get_origin(annotation) in (Annotated, Literal):
        return True
    return any(map(bounded, get_args(annotation)))


def adapter(annotation: Any) -> "TypeAdapter[Any]":
    """Return pydantic's check of an annotation: no conversions, no NaN and no infinity."""
    from pydantic import ConfigDict, TypeAdapter

    strict = ConfigDict(strict=True, arbitrary_types_allowed=True, allow_inf_nan=False)
    return TypeAdapter(annotation, config=strict)


def _check(name: str, value: Any, allowed: "TypeAdapter[Any]") -> None:
    """Raise a `ValueError` for a value out of range; a schedule is checked at both ends."""
    from pydantic import ValidationError

    if callable(value):
        for progress in (0.0, 1.0):
            _check(f"{name}({progress:.0f})", value(progress), allowed)
        return
    if getattr(value, "ndim", None) == 0:  # a number of NumPy or PyTorch
        value = value.item()
    try:
        allowed.validate_python(value)
    except ValidationError as error:
        raise ValueError(validation_message(error, value, name)) from None


def validation_message(error: "ValidationError", value: Any, name: str = "") -> str:
    """Return `KEY=VALUE must be ...` for the most deeply nested error in a value.

    `name` is the key of the value.
    """
    details = [(_path(detail["loc"], value), detail) for detail in error.errors(include_url=False)]
    path = max((path for path, _ in details), key=len)
    expected = [_expected(detail) for other, detail in details if other == path]
    for part in path:
        name = f"{name}[{part}]" if isinstance(part, int) else f"{name}.{part}".lstrip(".")
        value = value[part]
    return f"{name}={yaml_text(value)} must be {' or '.join(dict.fromkeys(expected))}"


def _expected(detail: Any) -> str:
    """Return what one of pydantic's errors says is expected."""
    context = detail.get("ctx", {})
    if context.get("class") == "Sequence":
        return "a list"
    if detail["type"] in WORDS:
        known = {k: f"{v:.15g}" if isinstance(v, float) else v for k, v in context.items()}
        return WORDS[detail["type"]].format_map(known)
    message: str = detail["msg"]
    return message.removeprefix("Input should be ")


def yaml_text(value: Any) -> str:
    """Return a short text of a value as in YAML."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    return textwrap.shorten(repr(value), 100, placeholder=" ...")


def _path(location: Iterable[int | str], value: Any) -> tuple[int | str, ...]:
    """Drop pydantic's tags of union members from the location of an error."""
    path: list[int | str] = []
    for part in location:
        is_index = isinstance(value, (list, tuple)) and isinstance(part, int) and part < len(value)
        if is_index or (isinstance(value, Mapping) and part in value):
            path.append(part)
            value = value[part]
    return tuple(path)
