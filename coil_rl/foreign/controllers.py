"""Controllers of other people as guides.

They may be Python objects with a state, functions, networks, entries of the env that a controller
inside writes, or actions from a file. A configuration names them, so everything that does not fit
is refused at construction, in one sentence.
"""

import copy
import importlib
import inspect
import io
import math
import os
import pickle
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase, is_tensor_collection, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer

from coil_rl.errors import did_you_mean
from coil_rl.files import LARGEST_TABLE, read_text
from coil_rl.foreign.faults import ForeignError, Predictor, action_array, foreign, predicts, shown
from coil_rl.foreign.functions import FunctionGuide
from coil_rl.foreign.networks import NetworkGuide, acts, maker_of_rows, restore, state_of
from coil_rl.transforms.action_space import ActionSpace, OwnChoices, nested_key, written_key

# Other minus signs, as text programs write them: hyphens, the sign itself, and dashes.
MINUS = str.maketrans(dict.fromkeys("\u2010\u2011\u2212\u2013\u2014\ufe63\uff0d", "-"))


class PerRow(TensorDictModuleBase):
    """Python controllers as a guide, one object for each row of the env.

    An object is made when its row first acts, and is not asked after the end of an episode, see
    `Guides`. `act(observation)` gets one NumPy array for each of `in_keys`, or choices in the
    numbering of the env, as a Gymnasium env gives them. It returns an action: numbers, an index or
    a one-hot vector. `reset()`, if there is one, is called at the start of each episode; without it
    each episode gets a new object. Objects with `state_dict()` and `load_state_dict(state)` are
    part of a checkpoint, networks with their plain attributes; without these, new episodes begin
    when a run is resumed. They are called one after the other: a batched guide is many times
    faster.

    What an object raises, or returns that is no action, is a `ForeignError` with its row and step.

    Args:
        make: makes an object; called without arguments.
        in_keys: entries to read, [*batch, ...].
        out_key: entry for the action, [*batch, A].
        title: name of the controller for messages; by default that of what makes it.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from coil_rl.transforms import GuideActions
        >>> class Lean:
        ...     def act(self, observation):
        ...         return int(observation[2] > 0)
        >>> env = TransformedEnv(GymEnv("CartPole-v1"), GuideActions({"lean": PerRow(Lean)}))
        >>> env.rollout(3)["guide_action"].shape
        torch.Size([3, 1, 2])
    """

    foreign = by_row = True

    def __init__(
        self,
        make: Callable[[], Any],
        in_keys: Sequence[NestedKey] = ("observation",),
        out_key: NestedKey = "action",
        title: str = "",
    ) -> None:
        self.read = [nested_key(key) for key in in_keys]
        self.in_keys, self.out_keys = [*self.read, "row", "is_init"], [nested_key(out_key)]
        super().__init__()
        self.make, self.objects = make, dict[int, Any]()
        self.title = title or getattr(getattr(make, "func", make), "__name__", repr(make))
        self.choices: OwnChoices = {}
        self.steps = dict[int, int]()  # of the running episode, by row
        self.asked: list[int] = []  # rows of the last call
        # whether the last restored state held those of the objects; else new episodes begin
        self.continues = True

    def reads_choices(self, choices: OwnChoices) -> None:
        """Read choices as the env gives them from here on, not as one-hot vectors.

        Args:
            choices: what converts an entry, by entry.
        """
        self.choices = choices

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        flat = tensordict.reshape(-1)
        rows, starts = (flat[key].flatten().tolist() for key in ("row", "is_init"))
        self.asked = rows
        columns = []
        for key in self.read:
            entry = flat[key]
            if is_tensor_collection(entry):
                raise ForeignError(_parts_of(key, entry))
            entry = self.choices[key](entry) if key in self.choices else entry
            columns.append(entry.cpu().numpy().copy())
        observations = zip(*columns, strict=True)
        actions: list[NDArray[Any]] = []
        for row, start, observed in zip(rows, starts, observations, strict=True):
            actions.append(self._action(row, start, observed))
            if actions[-1].shape != actions[0].shape:
                raise ForeignError(
                    f"{self._place(row)}: the action has the shape {list(actions[-1].shape)}, but "
                    f"that of row {rows[0]} has {list(actions[0].shape)}"
                )
        action = torch.as_tensor(np.stack(actions), device=tensordict.device)
        shape = (*tensordict.batch_size, *action.shape[1:])
        return tensordict.set(self.out_keys[0], action.reshape(shape))

    def _action(self, row: int, start: bool, observed: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return the action of the object of a row, which begins an episode at a `start`."""
        if start:
            self.steps[row] = 0
        elif row in self.steps:  # unknown after a resume
            self.steps[row] += 1
        with foreign(self._place(row), "act"):
            thing = self._object(row, start)
            answer = thing.act(*observed)
        try:
            return action_array(answer)
        except ForeignError as error:
            raise ForeignError(f"{self._place(row)}: {error}") from error

    def unfit(
        self, action: torch.Tensor, batch: torch.Size, space: ActionSpace, _: str
    ) -> ForeignError:
        """Return the error for an action that does not fit the env, see `unfit_action`."""
        number, returned, problem = space.unfit_row(action, batch)
        place = self._place(self.asked[number])
        return ForeignError(f"{place}: act returned {shown(returned)}, which {problem}")

    def _place(self, row: int) -> str:
        """Return the class of the controller, with the row and the step."""
        step = f", step {self.steps[row]}" if row in self.steps else ""
        return f"the controller {self.title} (row {row}{step})"

    def _object(self, row: int, start: bool) -> Any:
        """Return the object of a row, made anew or reset if this is the `start` of an episode."""
        if row not in self.objects or (start and not hasattr(self.objects[row], "reset")):
            with foreign(self._place(row), "the constructor"):
                self.objects[row] = self.make()
        if start and hasattr(self.objects[row], "reset"):
            with foreign(self._place(row), "reset"):
                self.objects[row].reset()
        return self.objects[row]

    def get_extra_state(self) -> dict[int, Any] | None:
        """Return the states by row; None if an object has none, or one that cannot be saved.

        A state that cannot be saved is a `ValueError`.
        """
        names = ("state_dict", "load_state_dict")
        if not all(hasattr(thing, name) for thing in self.objects.values() for name in names):
            return None
        states: dict[int, Any] = {}
        for row, thing in self.objects.items():
            with foreign(self._place(row), "state_dict"):
                states[row] = state_of(thing, self.make)
        if None in states.values():
            return None
        file = io.BytesIO()
        torch.save(states, file)
        file.seek(0)
        try:
            return dict(torch.load(file, weights_only=True))
        except pickle.UnpicklingError as error:
            raise ValueError(
                f"state_dict() of the controller {self.title} may hold numbers, texts, lists, "
                "dictionaries and tensors only; convert NumPy arrays by tolist()"
            ) from error

    def set_extra_state(self, state: Mapping[int, Any] | None) -> None:
        """Make objects with these states."""
        self.continues = state is not None
        if state is None:
            warnings.warn(
                f"the controller {self.title} has no state_dict() and load_state_dict(state) for "
                "all that it remembers, so new episodes begin",
                stacklevel=2,
            )
            state = {}
        self.steps.clear()
        self.objects = {row: self.make() for row in state}
        for row, thing in self.objects.items():
            with foreign(self._place(row), "load_state_dict"):
                restore(thing, state[row])


class ControllerGuide(TensorDictModuleBase):
    """A controller of somebody else. What it is decides how it is used.

    | it is | it becomes |
    | --- | --- |
    | a TensorDictModule, or a class of such | the guide itself, with its own `in_keys` |
    | a class with a method `act` | `PerRow`: one object for each row of the env |
    | an object with a method `act`, or a network with one | `PerRow`: one copy for each row |
    | a trained model with `predict`, as of Stable-Baselines3 | `PerRow`: one state for each row |
    | another `nn.Module`, or a class of such | `NetworkGuide`: entries [B, N] to actions [B, A] |
    | a function | `FunctionGuide`: of one observation, or of a batch of them |

    A `functools.partial` of a class is used as the class. Of a module with weights a copy is used,
    which alone a method may train.

    Args:
        of: the controller, or its name, such as `my_package.control:MyPID`.
        in_keys: entries to read; None for `observation`, or for those of a TensorDictModule.
        options: arguments of the class, or further ones of the function, by name.

    Raises:
        ValueError: for what cannot be imported, is nothing of the above, or takes other arguments.
    """

    foreign = True

    def __init__(
        self,
        of: Any,
        in_keys: Sequence[NestedKey] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        thing = load(of) if isinstance(of, str) else of
        if isinstance(thing, partial):  # Hydra has its own kind, which it checks at every call
            thing = partial(thing.func, *thing.args, **thing.keywords)
        title = getattr(_called(of), "__name__", type(of).__name__)
        if isinstance(of, (str, int, float)):
            title = str(of)
        keys = None if in_keys is None else [nested_key(key) for key in in_keys]
        make = _of_class if inspect.isclass(_called(thing)) else _of_object
        guide = make(thing, title, keys, dict(options or {}))
        self.in_keys, self.out_keys = guide.in_keys, guide.out_keys
        super().__init__()
        self.guide, self.pure = guide, getattr(_called(thing), "pure", False)
        self.title = title
        self.space: ActionSpace | None = None  # unknown outside of an env

    @property
    def by_row(self) -> bool:
        """Whether there is one object for each row, see `Guides`."""
        return isinstance(self.guide, PerRow)

    def in_space(self, space: ActionSpace) -> None:
        """Take the space of the actions of an env, and tell the controller if it asks for that.

        Args:
            space: of the actions.
        """
        self.space = space
        if hasattr(self.guide, "in_space"):
            self.guide.in_space(space)

    def reads_choices(self, choices: OwnChoices) -> None:
        """Let the controller read choices as the env gives them, unless it is a module.

        Args:
            choices: what converts an entry, by entry.
        """
        if isinstance(self.guide, (PerRow, FunctionGuide)):
            self.guide.reads_choices(choices)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action; what the controller raises is a `ForeignError`.

        A function or a network may give one number for each row, as regressors predict it.
        """
        with foreign(f"the controller {self.title}", "it"):
            tensordict = self.guide(tensordict)
        if self.space is not None and isinstance(self.guide, (FunctionGuide, NetworkGuide)):
            action = self.space.as_column(tensordict["action"], tensordict.batch_size)
            tensordict.set("action", action)
        return tensordict

    def unfit(
        self, action: torch.Tensor, batch: torch.Size, space: ActionSpace, problem: str
    ) -> ForeignError:
        """Return the error for an action that does not fit the env, see `unfit_action`."""
        if isinstance(self.guide, (PerRow, FunctionGuide)):
            return self.guide.unfit(action, batch, space, problem)
        return ForeignError(f"the controller {self.title}: its action {problem}")


def _called(thing: Any) -> Any:
    """Return the class or function that a `functools.partial` calls; anything else itself."""
    return thing.func if isinstance(thing, partial) else thing


def _of_class(
    make: Callable[..., Any], title: str, keys: list[NestedKey] | None, options: dict[str, Any]
) -> TensorDictModuleBase:
    """Return the guide of a class, or of a partial of one, made with `options`."""
    kind, read = _called(make), keys or ["observation"]
    is_module = issubclass(kind, nn.Module)
    if not (is_module or acts(kind) or predicts(kind)):
        raise ValueError(
            f"of={title} is a class without act(observation); give it this method, or name a "
            "function"
        )
    _check_call(make, title, [], options)
    made = partial(make, **options)
    if predicts(kind) and not issubclass(kind, TensorDictModuleBase):
        return _of_model(made, title, keys)
    if is_module:
        return _of_module(made(), title, keys)
    bound = isinstance(inspect.getattr_static(kind, "act"), (staticmethod, classmethod))
    _check_call(kind.act, f"{title}.act", read if bound else ["self", *read], {})
    return PerRow(made, read, title=title)


def _of_object(
    thing: Any, title: str, keys: list[NestedKey] | None, options: dict[str, Any]
) -> TensorDictModuleBase:
    """Return the guide of a function, or of an object that is made already."""
    is_module = isinstance(thing, nn.Module)
    if (is_module or acts(thing) or predicts(thing)) and options:
        raise ValueError(f"of={title} is an object, which takes no options; leave options out")
    if predicts(thing) and not isinstance(thing, TensorDictModuleBase):
        return _of_model(lambda: thing, title, keys)
    if is_module:
        return _of_module(_copy_of(thing, title), title, keys)
    read = keys or ["observation"]
    if acts(thing):
        _check_call(thing.act, f"{title}.act", read, {})
        return PerRow(maker_of_rows(thing), read, title=title)
    if not callable(thing):
        raise ValueError(
            f"of={title} is {type(thing).__name__}; name a class, a function, an object with "
            "act(observation), or a model with predict(observation, deterministic=True)"
        )
    _check_call(thing, title, read, options)
    return FunctionGuide(partial(thing, **options), read, title)


def _of_model(
    make: Callable[[], Any], title: str, keys: list[NestedKey] | None
) -> TensorDictModuleBase:
    """Return the guide of a trained model with `predict`.

    Args:
        make: returns the model, which has no state of its own; called once.
        title: name of the model, for messages.
        keys: entries to read; None for those of the model's observation space.
    """
    with foreign(f"the controller {title}", "the constructor"):
        model = make()
    parts = getattr(getattr(model, "observation_space", None), "spaces", None)
    if keys is None:
        keys = [nested_key(key) for key in parts] if isinstance(parts, Mapping) else ["observation"]
    return PerRow(partial(_ModelOfRow, model, keys), keys, title=title)


class _ModelOfRow(Predictor):
    """A trained model that gets the entries of a row as its observation space has them.

    Args:
        model: the model.
        keys: of the entries.
    """

    def __init__(self, model: Any, keys: Sequence[NestedKey]) -> None:
        super().__init__(model)
        self.keys = keys
        self.space = getattr(model, "observation_space", None)

    def act(self, *entries: NDArray[Any]) -> Any:
        """Return the deterministic action for the entries of a row."""
        parts = getattr(self.space, "spaces", None)
        if isinstance(parts, Mapping):
            named = zip(self.keys, entries, strict=True)
            return super().act({key: _in_space(entry, parts.get(key)) for key, entry in named})
        (entry,) = entries
        return super().act(_in_space(entry, self.space))

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


def _parts_of(key: NestedKey, entry: TensorDictBase) -> str:
    """Return the error message for a key that stands for several entries.

    Args:
        key: of the entry.
        entry: the entries inside it.
    """
    inner = entry.keys(include_nested=True, leaves_only=True)
    names = [written_key(unravel_key((key, part))) for part in inner]
    return (
        f"{written_key(key)} is not one entry but several; name those that the controller reads by "
        f"in_keys=[{','.join(names)}]"
    )


def _in_space(entry: NDArray[Any], space: Any) -> Any:
    """Return an entry as an observation of a Gymnasium space: choices are indices there."""
    if space is not None and entry.shape == space.shape:
        return entry
    if isinstance(space, spaces.Discrete):
        return int(entry.argmax()) + int(space.start)
    if isinstance(space, spaces.MultiDiscrete):
        parts = np.split(entry, np.cumsum(space.nvec.ravel())[:-1])
        indices = np.array([part.argmax() for part in parts]).reshape(space.nvec.shape)
        return indices + space.start
    if isinstance(space, spaces.Box) and entry.size == math.prod(space.shape):
        return entry.reshape(space.shape)
    return entry


def _copy_of(module: nn.Module, title: str) -> nn.Module:
    """Return a copy of a network, because some methods train their guides.

    A module without parameters is returned itself: nothing of it is trained.
    """
    if not any(True for _ in module.parameters()):
        return module
    with foreign(f"the controller {title}", "its copy"):
        return copy.deepcopy(module)


def _of_module(module: nn.Module, title: str, keys: list[NestedKey] | None) -> TensorDictModuleBase:
    """Return the guide of a module: its `act`, if its class has one, is what acts."""
    if isinstance(module, TensorDictModuleBase):
        if keys is not None:
            raise ValueError(f"of={title} has its own in_keys={module.in_keys}; leave in_keys out")
        return module
    read = keys or ["observation"]
    if not acts(module):
        return NetworkGuide(module, read, title)
    _check_call(module.act, f"{title}.act", read, {})  # type: ignore[arg-type]
    return PerRow(maker_of_rows(module), read, title=title)


class EntryGuide(TensorDictModule):
    """The action in an entry of the env, as of a controller inside of it.

    Such a controller may know more than agents observe.

    Args:
        key: the entry, [*batch, A].
    """

    sees = "env"

    def __init__(self, key: NestedKey | Sequence[str]) -> None:
        super().__init__(nn.Identity(), in_keys=[nested_key(key)], out_keys=["action"])


class RecordedGuide(TensorDictModuleBase):
    """Actions from a CSV file by the number of the step, from the first step of every episode on.

    The last one is held after the end of the file. The steering of a robot's recording is another
    guide, see `docs/imitation_from_recordings.md`.

    Args:
        file: a CSV of numbers, [T, A] in the env's unit, one line for each step, separated by
            commas, semicolons or white space. A first line with names is left out, and so is what
            follows a #. A file that cannot be read, or without finite numbers, is a `ValueError`.
    """

    in_keys, out_keys = ["recorded_step"], ["action", ("next", "recorded_step")]

    def __init__(self, file: str | os.PathLike[str]) -> None:
        super().__init__()
        self.actions: torch.Tensor = nn.Buffer(_read_actions(file), persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of the step, and the number of the next one."""
        step = tensordict["recorded_step"]
        action = self.actions[step.squeeze(-1).clamp(max=len(self.actions) - 1)]
        return tensordict.set("action", action).set(("next", "recorded_step"), step + 1)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Declare the number of the step as memory."""
        return TensorDictPrimer(
            {"recorded_step": Unbounded((1,), dtype=torch.int64)}, expand_specs=True
        )


def load(of: str) -> Any:
    """Return what is named by `MODULE:NAME`; raises a `ValueError` if it cannot be imported.

    Args:
        of: the name.
    """
    module, _, names = of.partition(":")
    if not module or not names:
        raise ValueError(f"of={of} must be MODULE:NAME, such as my_package.control:MyPID")
    try:
        thing: Any = importlib.import_module(module)
    except ModuleNotFoundError as error:
        # The missing module is the one that was named, or a package around it.
        if f"{module}.".startswith(f"{error.name}."):
            raise ValueError(
                f"of={of}: there is no module {error.name}; install its package, or add its folder "
                "to PYTHONPATH"
            ) from error
        raise ValueError(
            f"of={of}: {module} needs {error.name}, which is missing; install it"
        ) from error
    except Exception as error:
        raise ValueError(
            f"of={of}: {module} cannot be imported ({type(error).__name__}: {error})"
        ) from error
    for name in names.split("."):
        if not hasattr(thing, name):
            hint = did_you_mean(name, vars(thing)) or "; name another"
            raise ValueError(f"of={of}: {module} has no {names}{hint}")
        thing = getattr(thing, name)
    return thing


def _check_call(
    function: Callable[..., Any], title: str, entries: Sequence[Any], options: Mapping[str, Any]
) -> None:
    """Raise a `ValueError` if a function cannot be called like this.

    Args:
        function: the function or class.
        title: its name, for the message.
        entries: positional arguments, by the name of what they hold.
        options: arguments by name.
    """
    try:
        signature = inspect.signature(function)
    except ValueError:  # some functions written in C have none
        return
    try:
        signature.bind(*entries, **options)
    except TypeError as error:
        positional = [str(entry) for entry in entries if entry != "self"]
        given = ", ".join([*positional, *(f"{key}=" for key in options)])
        unknown = [key for key in options if key not in signature.parameters]
        hints = "".join(did_you_mean(key, signature.parameters) for key in unknown)
        raise ValueError(
            f"{title} takes {signature}, but is called with ({given}): {error}{hints}"
        ) from error


def _read_actions(file: str | os.PathLike[str]) -> torch.Tensor:
    """Return the actions of a CSV file, [T, A].

    Numbers are separated by commas, semicolons, tabs or spaces. A line that begins with # is a
    comment, and the first other one may hold names.
    """
    name = os.fspath(file)
    try:
        text = read_text(file, LARGEST_TABLE).removeprefix("\ufeff")  # as Excel writes it
        lines = [line.partition("#")[0].translate(MINUS).strip() for line in text.splitlines()]
    except (OSError, UnicodeError, ValueError) as error:
        raise ValueError(f"file={name} cannot be read as numbers with commas ({error})") from error
    rows = [_fields(line) for line in lines if line]
    if rows and not any(map(_is_number, rows[0])):
        del rows[0]
    widths = sorted({len(row) for row in rows})
    if len(widths) > 1:
        raise ValueError(
            f"file={name} cannot be read as numbers with commas (its lines have "
            f"{' and '.join(map(str, widths))} of them)"
        )
    try:
        actions = np.array(rows, dtype=np.float32)
    except ValueError as error:
        raise ValueError(f"file={name} cannot be read as numbers with commas ({error})") from error
    if not actions.size or not np.isfinite(actions).all():
        raise ValueError(f"file={name} must hold at least one line of finite numbers")
    return torch.from_numpy(actions)


def _fields(line: str) -> list[str]:
    """Return the fields of a line; a semicolon, a comma, or else white space separates them.

    With semicolons, a comma is the decimal point of a number.
    """
    if ";" in line:
        return [field.strip().strip('"').replace(",", ".") for field in line.split(";")]
    separator = "," if "," in line else None
    return [field.strip().strip('"') for field in line.split(separator)]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
