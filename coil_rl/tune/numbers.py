"""The numbers of a guide that `tune` names: which there are, their bounds, and nodes with others.

A number is an argument of the guide's class or function, or an item of a list of such: `kp`, and
`weights.2` for the third of some weights. Where a guide is made of something of a user, its
arguments are those of that class or function.
"""

import copy
import inspect
import math
import re
from collections.abc import Mapping
from functools import partial
from typing import Any

from omegaconf import DictConfig, OmegaConf, open_dict
from tensordict.nn import TensorDictModuleBase

from coil_rl.config.nodes import build, find_target, is_foreign
from coil_rl.errors import UserError, did_you_mean
from coil_rl.foreign.controllers import ControllerGuide, PerRow, load
from coil_rl.guides import classic
from coil_rl.plain_yaml import leaves
from coil_rl.ranges import yaml_text
from coil_rl.tune.search import Number

# Arguments of the parts of this project that are no numbers of a controller.
OTHERS = ("seed", "size")
AUTO = "auto"  # of `tune`: the bounds that the guide knows
# Words of the annotation of a whole number, or of a list of such, besides int.
AROUND_INT = frozenset(
    ["None", "Annotated", "Optional", "Union", "Sequence", "list", "List", "tuple", "Tuple"],
).union(["typing", "collections", "abc"])


def tuned_guide(config: DictConfig) -> tuple[str, dict[str, Any]]:
    """Return the name and the node of the only guide of a configuration.

    Raises:
        UserError: for no guide, or several.
    """
    if len(config.guide) != 1:
        names = ", ".join(map(str, config.guide)) or "none"
        raise UserError(f"method={config.method.name} tunes one guide, but there is {names}")
    ((name, node),) = config.guide.items()
    plain: Any = OmegaConf.to_container(node, resolve=True)
    return str(name), plain


def numbers_to_tune(config: DictConfig) -> list[Number]:
    """Return the numbers that `tune` names, with their bounds.

    Raises:
        UserError: for a number that the guide does not have, and for bounds that are none.
    """
    name, node = tuned_guide(config)
    known = numbers_of(node, f"guide.{name}")
    has = ", ".join(known)
    if not known:
        raise UserError(
            f"tune: guide.{name} has no numbers, so there is nothing to tune; numbers are the "
            "arguments of the class or function of a guide, with numbers as their defaults"
        )
    values = config.tune
    if OmegaConf.is_config(values):
        values = OmegaConf.to_container(values, resolve=True)
    if values == AUTO:
        values = _own_bounds(node, f"guide.{name}")
    if values and not isinstance(values, Mapping):
        raise UserError(
            f"tune={yaml_text(values)} must be the bounds by name, such as tune='{{kp: [0.1, 10, "
            f"log]}}'; guide.{name} has {has}"
        )
    wanted = leaves(values or {})
    if not wanted:
        raise UserError(
            f"method={config.method.name} needs the numbers to tune and their bounds, such as "
            f"tune='{{kp: [0.1, 10, log]}}'; guide.{name} has {has}"
        )
    for key in wanted:
        if key not in known:
            raise UserError(
                f"tune.{key} is no number of the guide; guide.{name} has {has}"
                f"{did_you_mean(key, known)}"
            )
    return [_number(key, bounds, *known[key]) for key, bounds in wanted.items()]


def _own_bounds(node: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the bounds that the class of a guide knows itself, by its method `tunable`."""
    target, _, arguments = _arguments(node, name)
    if not hasattr(target, "tunable"):
        raise UserError(
            f"tune={AUTO}: {name} knows no bounds; give them, such as tune='{{kp: [0.1, 10, log]}}'"
        )
    bounds: dict[str, Any] = target.tunable(arguments)
    return bounds


def _number(name: str, bounds: Any, own: float, whole: bool) -> Number:
    """Return a number with bounds `[low, high]` or `[low, high, log]`."""
    given = yaml_text(bounds)
    if not isinstance(bounds, list) or len(bounds) not in (2, 3) or bounds[2:] not in ([], ["log"]):
        raise UserError(
            f"tune.{name}={given} must be [low, high], or [low, high, log] to search the logarithm"
        )
    for each in bounds[:2]:
        if not _is_number(each):
            raise UserError(
                f"tune.{name}={given}: {yaml_text(each)} is not a number; give [low, high]"
            )
    low, high = map(float, bounds[:2])
    if low >= high:
        raise UserError(f"tune.{name}={given}: the lower bound must be below the upper one")
    if whole:
        low, high = float(math.ceil(low)), float(math.floor(high))
        if low >= high:
            raise UserError(
                f"tune.{name}={given}: {name} is a whole number, and there are no two between "
                "these bounds; give others"
            )
    if len(bounds) == 3 and low <= 0:
        raise UserError(
            f"tune.{name}={given}: the lower bound of a logarithm must be above 0; leave log out, "
            "or raise it"
        )
    return Number(name, low, high, own, log=len(bounds) == 3, whole=whole)


def numbers_of(node: Mapping[str, Any], name: str) -> dict[str, tuple[float, bool]]:
    """Return the numbers of a guide by name: own value, and whether it is an integer."""
    target, _, arguments = _arguments(node, name)
    found: dict[str, tuple[float, bool]] = {}
    for key, parameter in _parameters(target).items():
        if key in OTHERS and not is_foreign(target):
            continue
        value = arguments.get(key, parameter.default)
        whole = _is_whole(parameter.annotation)
        if _is_number(value):
            found[key] = float(value), whole
        elif isinstance(value, (list, tuple)) and value and all(map(_is_number, value)):
            found |= {f"{key}.{index}": (float(each), whole) for index, each in enumerate(value)}
    return found


def with_numbers(node: Mapping[str, Any], name: str, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the node of a guide with other numbers.

    Args:
        values: numbers by name.
    """
    changed = copy.deepcopy(dict(node))
    target, place, arguments = _arguments(changed, name)
    parameters = _parameters(target)
    for key, value in values.items():
        argument, _, index = key.partition(".")
        number = round(value) if _is_whole(parameters[argument].annotation) else value
        if not index:
            arguments[argument] = number
            continue
        items = list(arguments.get(argument, parameters[argument].default))
        items[int(index)] = number
        arguments[argument] = items
    return changed | {place: arguments} if place else arguments


def _arguments(node: Mapping[str, Any], name: str) -> tuple[Any, str, dict[str, Any]]:
    """Return the class or function of a guide's numbers, and where its arguments are, and these.

    They are the node itself, or the entry of the node that has the returned name.
    """
    target, place = find_target(node.get("_target_"), name), ""
    if target is ControllerGuide:
        of, place = node.get("of"), "options"
        target = load(of) if isinstance(of, str) else build(of, f"{name}.of")
    elif target is classic.ClassicGuide:
        target, place = getattr(classic, node["controller"]), "options"
    elif target is PerRow and isinstance(node.get("make"), Mapping):
        target, place = find_target(node["make"].get("_target_"), f"{name}.make"), "make"
    return target, place, dict(node.get(place) or {}) if place else dict(node)


def _parameters(target: Any) -> Mapping[str, inspect.Parameter]:
    """Return the arguments of a class or function; none of an object that is made already."""
    called = target.func if isinstance(target, partial) else target
    if not inspect.isclass(called) and not inspect.isroutine(called):
        return {}
    try:
        return inspect.signature(target).parameters
    except (TypeError, ValueError):
        return {}


def _is_whole(annotation: Any) -> bool:
    """Return whether an annotation is of whole numbers, such as `int | None` or `list[int]`."""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    words = {*re.findall(r"\w+", re.sub(r"\w+\([^()]*\)", "", text))}  # without ranges
    return words - AROUND_INT == {"int"}


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return math.isfinite(value)


class GuideWithNumbers:
    """Makes the guide of a configuration with other numbers.

    Args:
        config: with one guide.
    """

    def __init__(self, config: DictConfig) -> None:
        self.name, self.node = tuned_guide(config)

    def __call__(self, values: Mapping[str, float]) -> TensorDictModuleBase:
        """Return the guide with some values of its numbers.

        Args:
            values: by name.
        """
        name = f"guide.{self.name}"
        guide: TensorDictModuleBase = build(
            with_numbers(self.node, name, values), name, TensorDictModuleBase
        )
        return guide

    def words(self, values: Mapping[str, float]) -> list[str]:
        """Return the words of a command line that give the guide some values of its numbers."""
        name = f"guide.{self.name}"
        before, after = leaves(self.node), leaves(with_numbers(self.node, name, values))
        return [
            f"{'' if key in before else '+'}{name}.{key}={yaml_text(value)}"
            for key, value in after.items()
            if key not in before or before[key] != value
        ]


def with_values(config: DictConfig, values: Mapping[str, float]) -> DictConfig:
    """Return a configuration whose guide has other numbers.

    Args:
        config: with one guide; it stays as it is.
        values: by name.
    """
    name, node = tuned_guide(config)
    guides = {name: with_numbers(node, f"guide.{name}", values)}
    config = copy.deepcopy(config)
    with open_dict(config):
        for place in ("guide", "method.transforms.advice.guides"):
            OmegaConf.update(config, place, guides, merge=False)
    return config
