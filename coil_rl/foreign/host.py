"""Whatever acts for one row of an env: an object, a function or a trained model of somebody else.

What it is is decided here only, see `role_of`.
"""

import inspect
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import nn

from coil_rl.errors import did_you_mean
from coil_rl.foreign.codec import Entry
from coil_rl.foreign.faults import action_array, foreign
from coil_rl.foreign.guard import Numbers

INSTALLED = {"site-packages", "dist-packages"}  # folders of libraries
Role = Literal["guide", "act", "predict", "network", "function", ""]


def called(thing: Any) -> Any:
    """Return the class or function that a `functools.partial` calls; anything else itself."""
    return thing.func if isinstance(thing, partial) else thing


def is_of_user(thing: Any) -> bool:
    """Return whether a function or class is neither of Python, of a library nor of this package.

    Args:
        thing: the function or class.
    """
    name = str(getattr(thing, "__module__", ""))
    if name.partition(".")[0] in (*sys.stdlib_module_names, "coil_rl"):
        return False
    file = getattr(sys.modules.get(name), "__file__", None)
    return file is None or not INSTALLED & set(Path(file).parts)


def role_of(thing: Any) -> Role:
    """Return how a class, or an object, acts.

    It is a TensorDictModule ("guide"), or has a method `act` or, as trained models of other
    libraries do, a `predict` that takes `deterministic`. Or it is another network, or a function;
    empty for anything else.

    Args:
        thing: the class or object, or a `functools.partial` of a class or function.
    """
    thing = called(thing)
    kind = thing if inspect.isclass(thing) else type(thing)
    if issubclass(kind, TensorDictModuleBase):
        return "guide"
    act = getattr(thing, "act", None)
    if issubclass(kind, nn.Module):
        # An attribute `act` of a network is often its activation function.
        own = inspect.getattr_static(kind, "act", None)
        if inspect.isfunction(own) or isinstance(own, (staticmethod, classmethod)):
            return "act"
    elif callable(act):
        return "act"
    # The models of scikit-learn do not take `deterministic`.
    if not callable(act) and "deterministic" in _parameters(getattr(thing, "predict", None)):
        return "predict"
    if issubclass(kind, nn.Module):
        return "network"
    return "function" if callable(thing) and not inspect.isclass(thing) else ""


def _parameters(thing: Any) -> Mapping[str, inspect.Parameter]:
    """Return the parameters of a callable; none of anything else."""
    try:
        return inspect.signature(thing).parameters
    except (TypeError, ValueError):  # some that are written in C have no signature
        return {}


class Predictor:
    """A trained model of another library as a controller: what has `predict` gets `act`.

    The models of Stable-Baselines3 and its relatives have `predict(observation, state,
    episode_start, deterministic)`, which returns the action and the state for the next call.

    Args:
        model: the model. `predict` must take `deterministic`; the others are given if it takes
            them.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        self.space = getattr(model, "observation_space", None)
        parameters = inspect.signature(model.predict).parameters
        self.takes = {name for name in ("state", "episode_start") if name in parameters}
        self.reset()

    def reset(self) -> None:
        """Begin an episode: forget the state."""
        self.state, self.first = None, True

    def act(self, observed: Any) -> Any:
        """Return the deterministic action for an observation; of a Dict space a dictionary."""
        parts = getattr(self.space, "spaces", None)
        if isinstance(parts, Mapping):
            observed = {key: _in_space(entry, parts.get(key)) for key, entry in observed.items()}
        else:
            observed = _in_space(observed, self.space)
        given = {"state": self.state, "episode_start": np.array([self.first])}
        known = {name: given[name] for name in self.takes}
        answer = self.model.predict(observed, deterministic=True, **known)
        self.first = False
        if isinstance(answer, tuple) and len(answer) == 2:
            answer, self.state = answer
        return answer

    def state_dict(self) -> dict[str, Any]:
        """Return what the next actions of the episode depend on."""
        return {"first": self.first, "state": _mapped(torch.from_numpy, np.ndarray, self.state)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        self.first = state["first"]
        self.state = _mapped(torch.Tensor.numpy, torch.Tensor, state["state"])


def _mapped(convert: Callable[[Any], Any], kind: type, value: Any) -> Any:
    """Convert what is of a kind in nested tuples."""
    if isinstance(value, tuple):
        return tuple(_mapped(convert, kind, part) for part in value)
    return convert(value) if isinstance(value, kind) else value


def _in_space(entry: NDArray[Any], space: Any) -> Any:
    """Return an entry as an observation of a Gymnasium space: choices are indices there."""
    if space is None or entry.shape == space.shape:
        return entry
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return Entry("", (), space, entry.dtype).own(torch.from_numpy(entry)).numpy()[()]
    if isinstance(space, spaces.Box) and entry.size == math.prod(space.shape):
        return entry.reshape(space.shape)
    return entry


def asks_for_env(thing: Any) -> bool:
    """Return whether a class or function, or a partial of one, has a parameter `env`."""
    is_called = inspect.isclass(called(thing)) or role_of(thing) == "function"
    return is_called and "env" in _parameters(thing)


class Host:
    """The controller of one row: what it returns is checked, and its faults have their place.

    An object without `reset` is made anew for each episode.

    Args:
        make: makes an object with `act`; called without arguments.
        title: name of the controller, for messages.
        row: number of its row, for messages.
        beside: where the env is beside which it acts; None for a guide, which counts its own steps.

    Attributes:
        numbers: global random numbers as it sees them; those of its env, where it is beside one.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        title: str,
        row: int = 0,
        beside: Callable[[], str] | None = None,
    ) -> None:
        self.make, self.title, self.row, self.beside = make, title, row, beside
        self.thing: Any = None
        self.steps: int | None = None  # of the episode; unknown after a resume
        self.numbers = Numbers(torch.initial_seed() + row)

    @property
    def place(self) -> str:
        """The controller with its row and step."""
        if self.beside is not None:
            return f"the controller {self.title} beside {self.beside()}"
        step = "" if self.steps is None else f", step {self.steps}"
        return f"the controller {self.title} (row {self.row}{step})"

    def begin(self) -> None:
        """Begin an episode."""
        self.steps = 0
        if not hasattr(self.thing, "reset"):
            self.open()
        if hasattr(self.thing, "reset"):
            with foreign(self.place, "reset"):
                self.thing.reset()

    def open(self) -> None:
        """Make the object."""
        with foreign(self.place, "the constructor"):
            self.thing = self.make()

    def act(self, *observed: Any) -> NDArray[Any]:
        """Return the action for an observation, as an array of at least one dimension.

        Args:
            observed: what it reads; it may change that.

        Raises:
            ForeignError: for what the controller raises, or returns that is no array of numbers.
        """
        if self.thing is None:
            self.open()
        with foreign(self.place, "act"):
            return action_array(self.thing.act(*observed))


def check_call(
    function: Callable[..., Any], title: str, entries: Sequence[Any], options: Mapping[str, Any]
) -> bool:
    """Return whether a function takes several entries as one observation, see `observation_of`.

    A `ValueError` if it takes them neither so nor one by one.

    Args:
        function: the function or class.
        entries: positional arguments, by the name of what they hold.
        options: arguments by name.
    """
    try:
        signature = inspect.signature(function)
    except ValueError:  # some functions written in C have none
        return False
    own, read = (["self"], entries[1:]) if "self" in entries[:1] else ([], entries)
    try:
        signature.bind(*entries, **options)
    except TypeError as error:
        if len(read) > 1:
            with suppress(TypeError):
                signature.bind(*own, "observation", **options)
                return True
        given = ", ".join([*map(str, read), *(f"{key}=" for key in options)])
        unknown = [key for key in options if key not in signature.parameters]
        hints = "".join(did_you_mean(key, signature.parameters) for key in unknown)
        of_keys = "; in_keys=[ENTRY,...] names what it is called with"
        raise ValueError(
            f"{title} takes {signature}, but is called with ({given}): {error}"
            f"{of_keys if read and not unknown else hints}"
        ) from error
    return False


def observation_of(keys: Sequence[NestedKey], entries: Sequence[Any]) -> Any:
    """Return entries as one observation of a Dict or Tuple space.

    Args:
        keys: of the entries, as an env names them; those of a Tuple are numbers.
        entries: the entries.
    """
    whole: dict[str, Any] = {}
    for key, entry in zip(keys, entries, strict=True):
        *outer, last = (key,) if isinstance(key, str) else key
        place = whole
        for part in outer:
            place = place.setdefault(part, {})
        place[last] = entry
    parts = {key: _with_tuples(part) for key, part in whole.items()}
    given = parts.get("observation")  # under this name an env writes a Tuple, and what is no Dict
    return given if len(parts) == 1 and isinstance(given, tuple) else parts


def _with_tuples(part: Any) -> Any:
    """Return nested dictionaries with tuples in place of those whose keys are 0, 1, ..."""
    if not isinstance(part, dict):
        return part
    parts = {key: _with_tuples(each) for key, each in part.items()}
    return tuple(parts.values()) if [*parts] == [*map(str, range(len(parts)))] else parts
