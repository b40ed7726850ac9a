"""Controllers of other people as guides.

They may be Python objects with a state, functions, networks or trained models. A configuration
names them, so everything that does not fit is refused at construction, in one sentence.
"""

import copy
import importlib
import inspect
import pickle
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase, is_tensor_collection, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from coil_rl.errors import did_you_mean
from coil_rl.foreign.faults import ForeignError, foreign, shown
from coil_rl.foreign.guard import NUMBERS, Guard, hold
from coil_rl.foreign.host import (
    Host,
    Predictor,
    asks_for_env,
    called,
    check_call,
    observation_of,
    role_of,
)
from coil_rl.foreign.remembered import Anew, copied, maker_of_rows, state_of
from coil_rl.foreign.shared import SharedGuide
from coil_rl.transforms.action_space import ActionSpace, OwnForms, nested_key, written_key
from coil_rl.transforms.hosted import HostedGuide, ToldGuide


class PerRow(HostedGuide):
    """Python controllers as a guide, one object for each row of the env.

    An object is made when its row first acts, and is not asked after the end of an episode, see
    `Guides`. `act(observation)` gets one NumPy array for each of `in_keys`; whole numbers and
    choices are as a Gymnasium env gives them. It returns an action: numbers, an index or a one-hot
    vector. `reset()`, if there is one, is called at the start of each episode; without it each
    episode gets a new object. Objects with `state_dict()` and `load_state_dict(state)` are
    part of a checkpoint; without these, and for networks that remember more than `state_dict()`
    has, new episodes begin when a run is resumed. They are called one after the other: a batched
    guide is many times faster.

    What an object raises, or returns that is no action, is a `ForeignError` with its row and step.

    Args:
        make: makes an object; called without arguments.
        in_keys: entries to read, [*batch, ...].
        out_key: entry for the action, [*batch, A].
        title: name of the controller for messages; by default that of what makes it.
        as_one: whether `act` takes all entries as one observation: a dictionary, or a tuple.

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

    by_row = True

    def __init__(
        self,
        make: Callable[[], Any],
        in_keys: Sequence[NestedKey] = ("observation",),
        out_key: NestedKey = "action",
        title: str = "",
        as_one: bool = False,
    ) -> None:
        self.read = [nested_key(key) for key in in_keys]
        self.in_keys, self.out_keys = [*self.read, "row", "is_init"], [nested_key(out_key)]
        super().__init__()
        self.make, self.hosts, self.as_one = make, dict[int, Host](), as_one
        self.guard = Guard()
        self.title = title or getattr(getattr(make, "func", make), "__name__", repr(make))
        self.own: OwnForms = {}
        self.asked: list[int] = []  # rows of the last call
        # whether the last restored state held those of the objects; else new episodes begin
        self.continues = True

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Read whole numbers and choices as the env gives them from here on."""
        self.own = own

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        flat = tensordict.reshape(-1)
        rows, starts = (flat[key].flatten().tolist() for key in ("row", "is_init"))
        self.asked = rows
        columns = []
        for key in self.read:
            entry = flat[key]
            if is_tensor_collection(entry):
                inner = entry.keys(include_nested=True, leaves_only=True)
                names = ",".join(written_key(unravel_key((key, part))) for part in inner)
                raise ForeignError(
                    f"{written_key(key)} is not one entry but several; name those that the "
                    f"controller reads by in_keys=[{names}]"
                )
            entry = self.own[key](entry) if key in self.own else entry
            columns.append(entry.cpu().numpy().copy())
        observations = zip(*columns, strict=True)
        actions: list[NDArray[Any]] = []
        with self.guard:
            for row, start, observed in zip(rows, starts, observations, strict=True):
                actions.append(self._asked(row, start, observed))
                if actions[-1].shape != actions[0].shape:
                    raise ForeignError(
                        f"{self.hosts[row].place}: the action has the shape "
                        f"{list(actions[-1].shape)}, but that of row {rows[0]} has "
                        f"{list(actions[0].shape)}"
                    )
        if self.guard.touched:
            for row, host in self.hosts.items():
                host.numbers.use(torch.initial_seed() + row)
        action = torch.as_tensor(np.stack(actions), device=tensordict.device)
        shape = (*tensordict.batch_size, *action.shape[1:])
        return tensordict.set(self.out_keys[0], action.reshape(shape))

    def _asked(self, row: int, start: bool, observed: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """Return the action of the controller of a row, which begins an episode at a `start`."""
        if row not in self.hosts:
            self.hosts[row] = Host(self.make, self.title, row)
        host = self.hosts[row]
        with host.numbers:
            if start:
                host.begin()
            elif host.steps is not None:
                host.steps += 1
            return host.act(*([observation_of(self.read, observed)] if self.as_one else observed))

    def unfit(
        self, action: torch.Tensor, batch: torch.Size, space: ActionSpace, problem: str
    ) -> ForeignError:
        """Return the error for an action that does not fit the env."""
        number, returned, problem = space.unfit_row(action, batch)
        place = self.hosts[self.asked[number]].place
        return ForeignError(f"{place}: act returned {shown(returned)}, which {problem}")

    def get_extra_state(self) -> dict[Any, Any] | None:
        """Return the states by row; None if an object has none, or one that cannot be saved.

        A state that cannot be saved is a `ValueError`.
        """
        states: dict[Any, Any] = {}
        for row, host in self.hosts.items():
            if not all(hasattr(host.thing, name) for name in ("state_dict", "load_state_dict")):
                return None
            with foreign(host.place, "state_dict"):
                states[row] = state_of(host.thing, self.make)
        if None in states.values():
            return None
        numbers = {row: host.numbers.state_dict() for row, host in self.hosts.items()}
        if any(numbers.values()):
            states[NUMBERS] = numbers
        try:
            return dict(copied(states))
        except pickle.UnpicklingError as error:
            raise ValueError(
                f"state_dict() of the controller {self.title} may hold numbers, texts, lists, "
                "dictionaries and tensors only; convert NumPy arrays by tolist()"
            ) from error

    def set_extra_state(self, state: Mapping[Any, Any] | None) -> None:
        """Make objects with these states."""
        self.continues = state is not None
        if state is None:
            warnings.warn(
                f"the controller {self.title} has no state_dict() and load_state_dict(state) for "
                "all that it remembers, so new episodes begin",
                stacklevel=2,
            )
            state = {}
        state = dict(state)
        numbers = state.pop(NUMBERS, {})
        self.hosts = {row: Host(self.make, self.title, row) for row in state}
        for row, host in self.hosts.items():
            with self.guard, host.numbers:
                host.open()
            host.numbers.load_state_dict(numbers.get(row, {}))
            with foreign(host.place, "load_state_dict"):
                host.thing.load_state_dict(state[row])


class ControllerGuide(HostedGuide):
    """A controller of somebody else. What it is decides how it is used.

    | it is | it becomes |
    | --- | --- |
    | a TensorDictModule, or a class of such | the guide itself, with its own `in_keys` |
    | a class with a method `act` | `PerRow`: one object for each row of the env |
    | an object with a method `act`, or a network with one | `PerRow`: one copy for each row |
    | a trained model with `predict`, as of Stable-Baselines3 | `PerRow`: one state for each row |
    | another `nn.Module`, or a class of such | `SharedGuide`: entries [B, N] to actions [B, A] |
    | a function | `SharedGuide`: of one observation, or of a batch of them |

    A `functools.partial` of a class is used as the class. Of a module with weights a copy is used,
    which alone a method may train.

    Args:
        of: the controller, or its name, such as `my_package.control:MyPID`.
        in_keys: entries to read, an argument each, or a dictionary of them for what takes one
            argument; None for `observation`, or for those of a TensorDictModule.
        options: arguments of the class, or further ones of the function, by name.

    Raises:
        ValueError: for what cannot be imported, is nothing of the above, or takes other arguments.
    """

    def __init__(
        self,
        of: Any,
        in_keys: Sequence[NestedKey] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        with Guard():
            thing = load(of) if isinstance(of, str) else of
        if isinstance(thing, partial):  # Hydra has its own kind, which it checks at every call
            thing = partial(thing.func, *thing.args, **thing.keywords)
        title = getattr(called(of), "__name__", type(of).__name__)
        if isinstance(of, (str, int, float)):
            title = str(of)
        if asks_for_env(thing) and "env" not in (options or {}):
            raise ValueError(
                f"of={title} asks for its env: let it act beside that, by guide=entry "
                f"guide.entry.key=[controller,its] +env.controllers.its={title}"
            )
        keys = None if in_keys is None else [nested_key(key) for key in in_keys]
        guide = _guide_of(thing, title, keys, dict(options or {}))
        self.in_keys, self.out_keys = guide.in_keys, guide.out_keys
        super().__init__()
        self.guide, self.title = guide, title
        self.remedy = (
            "name those that it reads by in_keys=[ENTRY,...]"
            if isinstance(guide, HostedGuide)
            else ""
        )

    @property
    def by_row(self) -> bool:  # type: ignore[override]
        """Whether there is one object for each row, see `Guides`."""
        return isinstance(self.guide, PerRow)

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Tell the controller about its env, if it asks for that."""
        if isinstance(self.guide, ToldGuide):
            self.guide.meet(space, own)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action; what the controller raises is a `ForeignError`."""
        with foreign(f"the controller {self.title}", "it"):
            return self.guide(tensordict)

    def unfit(
        self, action: torch.Tensor, batch: torch.Size, space: ActionSpace, problem: str
    ) -> Exception | None:
        """Return the error for an action that does not fit the env."""
        if isinstance(self.guide, HostedGuide):
            return self.guide.unfit(action, batch, space, problem)
        return ForeignError(f"the controller {self.title}: its action {problem}")


def _guide_of(
    thing: Any, title: str, keys: list[NestedKey] | None, options: dict[str, Any]
) -> TensorDictModuleBase:
    """Return the guide of a class, a partial of one, a function, or an object."""
    role, read, is_class = role_of(thing), keys or ["observation"], inspect.isclass(called(thing))
    if not role:
        what = "a class without act(observation)" if is_class else type(thing).__name__
        is_regressor = callable(getattr(thing, "predict", None))
        raise ValueError(
            f"of={title} is {what}; name a class or an object with act(observation), a function, "
            "or a model with predict(observation, deterministic=True)"
            f"{'; its predict is a function: of=MODULE:NAME.predict' if is_regressor else ''}"
        )
    if role == "function":
        as_one, function = check_call(thing, title, read, options), partial(thing, **options)
        return SharedGuide(
            (lambda *given: function(observation_of(read, given))) if as_one else function,
            read,
            title,
        )
    if is_class:
        check_call(thing, title, [], options)
        make, kind = Anew(thing, **options), called(thing)
        if role == "act" and not issubclass(kind, nn.Module):
            bound = isinstance(inspect.getattr_static(kind, "act"), (staticmethod, classmethod))
            as_one = check_call(kind.act, f"{title}.act", read if bound else ["self", *read], {})
            return PerRow(make, read, title=title, as_one=as_one)
        with foreign(f"the controller {title}", "the constructor"):
            thing = make()
    elif options:
        raise ValueError(f"of={title} is an object, which takes no options; leave options out")
    elif isinstance(thing, nn.Module) and role != "predict" and [*thing.parameters()]:
        with foreign(f"the controller {title}", "its copy"):
            thing = copy.deepcopy(thing)  # some methods train their guides
    return _of_object(thing, title, keys)


def _of_object(thing: Any, title: str, keys: list[NestedKey] | None) -> TensorDictModuleBase:
    """Return the guide of an object; a method `act` is what acts, if its class has one.

    Args:
        keys: entries to read; None for `observation`, or those of a model's observation space.
    """
    role, read = role_of(thing), keys or ["observation"]
    if role == "guide":
        if keys is not None:
            raise ValueError(f"of={title} has its own in_keys={thing.in_keys}; leave in_keys out")
        return hold(thing)
    if role == "network":
        return SharedGuide(thing, read, title)
    if role == "act":
        return PerRow(
            maker_of_rows(thing),
            read,
            title=title,
            as_one=check_call(thing.act, f"{title}.act", read, {}),
        )
    parts = getattr(getattr(thing, "observation_space", None), "spaces", None)
    if keys is None and isinstance(parts, Mapping):
        read = [nested_key(key) for key in parts]
    elif len(read) > 1 and not isinstance(parts, Mapping):
        raise ValueError(
            f"of={title} predicts from one entry, as its observation_space is no Dict, but in_keys "
            f"names {', '.join(map(written_key, read))}; name one"
        )
    return PerRow(partial(Predictor, thing), read, title=title, as_one=isinstance(parts, Mapping))


def load(of: str, key: str = "of") -> Any:
    """Return what is named by `MODULE:NAME`; raises a `ValueError` if it cannot be imported.

    Args:
        key: of the argument that names it, for the message.
    """
    module, _, names = of.partition(":")
    if not module or not names:
        raise ValueError(f"{key}={of} must be MODULE:NAME, such as my_package.control:MyPID")
    try:
        thing: Any = importlib.import_module(module)
    except ModuleNotFoundError as error:
        # The missing module is the one that was named, or a package around it.
        if f"{module}.".startswith(f"{error.name}."):
            raise ValueError(
                f"{key}={of}: there is no module {error.name}; install its package, or add its "
                "folder to PYTHONPATH"
            ) from error
        raise ValueError(
            f"{key}={of}: {module} needs {error.name}, which is missing; install it"
        ) from error
    except Exception as error:
        raise ValueError(
            f"{key}={of}: {module} cannot be imported ({type(error).__name__}: {error})"
        ) from error
    for name in names.split("."):
        if not hasattr(thing, name):
            hint = did_you_mean(name, vars(thing)) or "; name another"
            raise ValueError(f"{key}={of}: {module} has no {names}{hint}")
        thing = getattr(thing, name)
    return thing
