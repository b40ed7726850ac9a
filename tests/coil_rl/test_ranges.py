"""Arguments are checked against the ranges and choices in their annotations."""

import importlib
import inspect
import math
import pkgutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypedDict, Unpack

import numpy as np
import pytest
import torch

import coil_paper
import coil_rl
from coil_rl.config.nodes import check_arguments
from coil_rl.errors import UserError
from coil_rl.ranges import Count, Interval, Len, NonNegative, Positive, Share, checked
from coil_rl.schedules import Linear, Schedule


@checked
def function(
    size: Count = 1,
    share: Share | None = None,
    rate: NonNegative | Schedule = 0.0,
    kind: Literal["near", "far"] = "near",
    widths: Annotated[Sequence[Annotated[int, Interval(ge=1, le=9)]], Len(0, 3)] = (),
    switch: bool | Literal["auto"] = "auto",
    free: float = 0.0,
) -> str:
    return kind


class Settings(TypedDict, total=False):
    scale: Positive


@checked
@dataclass(frozen=True)
class Base:
    scale: Positive = 1.0
    hidden: int = 0


@checked
class Part(Base):
    def __init__(self, *, own: Count = 1, **settings: Unpack[Settings]) -> None:
        super().__init__(**settings)


MISTAKES = [
    ({"size": 0}, "size=0 must be at least 1"),
    ({"size": 1.5}, "size=1.5 must be a valid integer"),
    ({"share": 1.5}, "share=1.5 must be at most 1"),
    ({"share": math.nan}, "share=nan must be a finite number"),
    ({"rate": -1}, "rate=-1 must be at least 0"),
    ({"kind": "middle"}, "kind='middle' must be 'near' or 'far'"),
    ({"widths": [4, 10]}, r"widths\[1\]=10 must be at most 9"),
    ({"widths": [1, 2, 3, 4]}, r"widths=\[1, 2, 3, 4\] must be at most 3 long"),
    ({"switch": "yes"}, "switch='yes' must be a valid boolean or 'auto'"),
]


@pytest.mark.parametrize(("arguments", "message"), MISTAKES)
def test_value_out_of_range_is_one_sentence_in_python_and_in_yaml(arguments, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        function(**arguments)
    with pytest.raises(UserError, match=rf"^part\.{message}"):
        check_arguments(function, arguments, "part")


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"size": np.int64(2), "share": np.float32(0.5), "rate": torch.tensor(1.0)},
        {"share": 1, "rate": Linear(1.0, 0.0), "widths": (1, 9), "switch": True},
        {"widths": []},
    ],
)
def test_values_in_range_pass_as_they_are(arguments):
    assert function(**arguments) == "near"


def test_schedule_is_checked_at_both_ends_of_the_run():
    with pytest.raises(ValueError, match=r"rate\(0\)=-1\.0 must be at least 0"):
        function(rate=Linear(-1.0, 1.0))
    with pytest.raises(ValueError, match=r"rate\(1\)=-1\.0 must be at least 0"):
        function(rate=Linear(1.0, -1.0))


def test_settings_reach_the_base_class_and_others_are_refused():
    assert Part(scale=2.0).scale == 2
    with pytest.raises(ValueError, match="scale=0 must be more than 0"):
        Part(scale=0)
    with pytest.raises(ValueError, match="own=0 must be at least 1"):
        Part(own=0)
    with pytest.raises(TypeError, match="Part takes no hidden"):
        Part(hidden=1)
    Part.__module__ = "coil_rl.part"
    with pytest.raises(UserError, match="part: Part takes no hidden; it takes own, scale"):
        check_arguments(Part, {"hidden": 1}, "part")


def test_import_does_not_wait_for_pydantic():
    code = "import coil_rl.ranges, sys; print('pydantic' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def callables() -> Iterator[Any]:
    """Yield the functions and constructors that the project defines."""
    for package in (coil_rl, coil_paper):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if module.name.endswith((".schema", ".ros_node")):
                continue  # of a configuration as a whole; needs ROS
            for thing in vars(importlib.import_module(module.name)).values():
                if getattr(thing, "__module__", None) != module.name:
                    continue
                if inspect.isclass(thing) and "__init__" in vars(thing):
                    yield thing.__init__
                elif inspect.isfunction(thing):
                    yield thing


def test_whatever_has_a_range_is_checked():
    unchecked = []
    for each in callables():
        texts = [str(annotation) for annotation in getattr(each, "__annotations__", {}).values()]
        has_range = any("Annotated[" in text or "Unpack[" in text for text in texts)
        if has_range and not hasattr(each, "__wrapped__"):
            unchecked.append(f"{each.__module__}.{each.__qualname__}")
    assert unchecked == []
