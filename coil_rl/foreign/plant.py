"""Rows of single Gymnasium envs, with controllers beside them."""

import copy
import inspect
import math
import pkgutil
import warnings
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from coil_rl.foreign.batch import RowsInTurn
from coil_rl.foreign.codec import Entry, Fineness, has_whole_numbers, leaves
from coil_rl.foreign.faults import (
    EnvGate,
    ForeignError,
    acting,
    foreign,
    limit_by_attributes,
    plain_array,
    predicts,
    shown,
)
from coil_rl.foreign.makers import Env, time_limits_of
from coil_rl.foreign.workers import Entries

MASKS = {"action_mask", "action_masks"}  # in info: which actions are possible
# The envs of all rows of this process, to find one that two rows would share.
_alive: MutableMapping[int, Any] = WeakValueDictionary()


class Row:
    """One Gymnasium env and the controllers beside it; see `rows` of `SeededRows`.

    Args:
        make: makes the env.
        makers: make the controllers, by name.
        fresh: whether every episode has a new env.
        name: of the env, for messages.
        number: of the row.
        dtype: of numbers.

    Attributes:
        entries: of the observation.
        fineness: watch on the rewards of all rows.
        observation: the last one, as the env returned it.
        values: copies of its entries.
    """

    def __init__(
        self,
        make: Callable[[], Env],
        makers: Mapping[str, Callable[..., Any]],
        fresh: bool,
        name: str,
        number: int,
        dtype: np.dtype[Any],
    ) -> None:
        self.make, self.makers, self.fresh = make, makers, fresh
        self.name, self.number, self.dtype = name, number, dtype
        self.entries: Sequence[Entry] = ()
        self.fineness: Fineness | None = None  # of the rewards
        self.values: list[NDArray[Any]] = []
        self.advice: dict[str, NDArray[Any]] = {}
        self._open()

    def _open(self) -> None:
        env = self.make()
        own = _alive.get(id(env.unwrapped))
        if own is env.unwrapped:
            raise ValueError(
                f"the maker of {self.name} returned one env twice: its rows would disturb each "
                "other; make a new env at each call"
            )
        with suppress(TypeError):  # an object without weak references
            _alive[id(env.unwrapped)] = env.unwrapped
        limit = None if _has_limit(env) else limit_by_attributes(env.unwrapped)
        self.gate = EnvGate(env, self.name, self.number, self.dtype, limit)
        self.controllers = {
            name: controller_of(name, maker, env) for name, maker in self.makers.items()
        }

    def begin(self, seed: int) -> None:
        """Begin an episode."""
        if self.fresh:
            self.gate.close()
            _alive.pop(id(self.gate.env.unwrapped), None)
            self._open()
        self.observation, self.info = self.gate.reset(seed)
        self._look_for_masks()
        self.values = self.gate.read(self.observation, self.entries)
        self.reward, self.terminated, self.truncated = 0.0, False, False
        self._reset_controllers()
        self._advise()

    def observe(self, observation: Any, *, first: bool) -> None:
        """Take an observation that comes from elsewhere."""
        if not hasattr(self, "observation"):
            self.begin(0)  # controllers may read what an env has after its reset only
        self.observation, self.reward, self.info = observation, 0.0, {}
        try:
            self.values = [entry(observation) for entry in self.entries]
        except ForeignError as error:
            raise ValueError(f"it does not fit the env {self.name}: {error}") from error
        if first:
            self._reset_controllers()
        self._advise()

    def step(self, action: Any) -> None:
        """Take a step; a row whose episode is over stays as it is, with reward 0."""
        if self.terminated or self.truncated:
            self.reward = 0.0
            return
        self.observation, self.reward, self.terminated, self.truncated, self.info = self.gate.step(
            action
        )
        if self.fineness is not None and self.fineness.unseen:
            self.fineness.see(np.asarray(self.reward))
        self.values = self.gate.read(self.observation, self.entries)
        if self.controllers and not self.terminated:
            self._advise()

    def _look_for_masks(self) -> None:
        """Warn if info has a mask of the possible actions, which policies do not read."""
        for name in MASKS & self.info.keys():
            warnings.warn(
                f"the env {self.name} has {name} in info, which is not used: policies and guides "
                "choose among all actions, so the env must have an answer to each",
                stacklevel=2,
            )

    def number_of(self, name: str) -> float:
        """Return a number of info, NaN where it is missing."""
        value = self.info.get(name, math.nan)
        if np.ndim(value) == 1 and np.size(value) == 1:
            value = np.ravel(value)[0]
        with self.gate.placed():
            if isinstance(value, (str, bytes)) or np.ndim(value) > 0:
                raise ForeignError(f"info entry {name!r} is {shown(value)}, which is not a number")
            try:
                return float(value)
            except (TypeError, ValueError) as error:
                raise ForeignError(
                    f"info entry {name!r} is {shown(value)}, which is not a number"
                ) from error

    def _reset_controllers(self) -> None:
        for name, (_, reset) in self.controllers.items():
            with foreign(f"the controller {name}", "reset"):
                reset()

    def _advise(self) -> None:
        for name, (act, _) in self.controllers.items():
            # A copy, as the env may go on with the arrays that it returned.
            observation = copy.deepcopy(self.observation)
            with foreign(f"the controller {name} beside {self.gate.place}", "it"):
                advice = act(observation)
            self.advice[name] = self._fitted(name, advice)

    def _fitted(self, name: str, advice: Any) -> NDArray[Any]:
        """Return the action of a controller as an array, in the env's own numbering."""
        with self.gate.placed():
            return fitted_action(name, advice, self.gate.env.action_space)


class Rows(RowsInTurn):
    """Rows that are stepped one after the other in one process, see `Shard` of the workers.

    Args:
        make_row: makes a row by its number.
        numbers: of the rows.
        info: names of numbers in Gymnasium's info.
        like: an env whose spaces those of all rows must be; by default that of the first row.
    """

    def __init__(
        self,
        make_row: Callable[[int], "Row"],
        numbers: range,
        info: Sequence[str],
        like: Env | None = None,
    ) -> None:
        self.info, self.unseen = tuple(info), set(info)
        self.rows: list[Row] = [make_row(numbers[0])]
        first = self.rows[0]
        self.like = first.gate.env if like is None else like
        self.entries = entries_of(first.name, self.like, first.dtype)
        self.fineness = Fineness(f"the env {first.name}", "the reward", first.dtype)
        self._fit(first)
        self.extend(make_row, len(numbers), numbers[0])

    def extend(self, make_row: Callable[[int], "Row"], count: int, start: int = 0) -> None:
        """Make further rows.

        Args:
            make_row: makes a row by its number.
            count: of all rows.
            start: number of the first row.
        """
        for number in range(start + len(self.rows), start + count):
            row = make_row(number)
            self._fit(row)
            self.rows.append(row)

    def _fit(self, row: "Row") -> None:
        row.entries, row.fineness = self.entries, self.fineness
        if row.gate.env is not self.like:
            _check_same_spaces(row.name, row.number, row.gate.env, self.like)

    def entries_of_rows(self) -> Entries:
        """Return the entries of all rows, [rows, ...], and their rewards."""
        rows, count = self.rows, len(self.rows)
        terminated = np.array([[row.terminated] for row in rows])
        truncated = np.array([[row.truncated] for row in rows])
        found: Entries = {
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
            "reward": np.array([[row.reward] for row in rows], dtype=rows[0].dtype),
        }
        for index, entry in enumerate(self.entries):
            joined = np.concatenate([row.values[index] for row in rows])
            key = entry.key if len(entry.key) > 1 else entry.key[0]
            found[key] = joined.reshape(count, *entry.given)
        if self.unseen:
            self._look_for_info()
        for name in self.info:
            numbers = np.array([row.number_of(name) for row in rows], dtype=rows[0].dtype)
            found["info", name] = numbers.reshape(-1, 1)
        for name in rows[0].controllers:
            found["controller", name] = np.array([row.advice[name] for row in rows])
        return found

    def _look_for_info(self) -> None:
        """Warn of a name that no info has had when the first episode is over."""
        self.unseen.difference_update(*(row.info for row in self.rows))
        if self.unseen and any(row.terminated or row.truncated for row in self.rows):
            missing = ", ".join(sorted(self.unseen))
            known = sorted({str(name) for row in self.rows for name in row.info})
            warnings.warn(
                f"the env {self.rows[0].name} had no {missing} in the info of an episode, so it is "
                "NaN there, a number without a value; at its end info has "
                f"{', '.join(known) or 'nothing'}",
                stacklevel=2,
            )
            self.unseen.clear()

    def picture(self, row: int) -> NDArray[np.uint8]:
        """Return a picture of a row."""
        return self.rows[row].gate.render()

    def close(self) -> None:
        """Close all envs."""
        for row in self.rows:
            row.gate.close()


def fitted_action(name: str, advice: Any, space: spaces.Space[Any]) -> NDArray[Any]:
    """Return the action of a controller as an array, in the env's own numbering.

    Args:
        name: of the controller, for the message.
        advice: what the controller gave.
        space: of the env's actions; the bounds of real numbers are not checked.

    Raises:
        ForeignError: for what is no action of the env.
    """
    try:
        array = plain_array(advice, "it")
        if has_whole_numbers(space):
            whole = array.astype(space.dtype)
            fits = bool((whole == array).all()) and space.contains(whole)
        elif isinstance(space, spaces.Box):
            fits = array.shape == space.shape and bool(np.isfinite(array).all())
        else:
            fits = bool(space.contains(array))
    except ForeignError:
        fits = False
    if not fits:
        raise ForeignError(f"controller {name} gave {shown(advice)}, not an action of {space}")
    return np.array(array)


def resolved_controller(name: str, thing: str | Callable[..., Any]) -> Callable[..., Any]:
    """Return a controller by its import path PACKAGE.MODULE:THING."""
    if not isinstance(thing, str):
        return thing
    try:
        return pkgutil.resolve_name(thing)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"controller {name}: {thing!r} cannot be imported ({error}); write PACKAGE.MODULE:THING"
        ) from error


def controller_of(
    name: str, maker: Callable[..., Any], env: Env
) -> tuple[Callable[[Any], Any], Callable[[], Any]]:
    """Make a controller for an env.

    Args:
        name: of the controller, for messages.
        maker: a class, a function or a `functools.partial` of either; or an object with `act` or
            `predict`.
        env: beside which the controller acts.

    Returns:
        What gives the action for an observation, and what to call at the start of an episode.
    """
    if not inspect.isclass(getattr(maker, "func", maker)):
        if not predicts(maker) and not callable(getattr(maker, "act", None)):
            return partial(maker, env), lambda: None
        controller = acting(maker)
        return controller.act, getattr(controller, "reset", lambda: None)
    try:
        controller = maker(env)
    except TypeError as error:
        raise ValueError(f"controller {name} cannot be made with its env: {error}") from error
    if predicts(controller):
        controller = acting(controller)
    if not callable(getattr(controller, "act", None)):
        raise ValueError(
            f"controller {name}: {type(controller).__name__} needs a method act(observation)"
        )
    return controller.act, getattr(controller, "reset", lambda: None)


def _has_limit(env: Env) -> bool:
    """Return whether something around an env ends an episode after a number of steps."""
    spec = getattr(env, "spec", None)
    if getattr(spec, "max_episode_steps", None):
        return True
    return bool(time_limits_of(env))


def entries_of(name: str, env: Env, floats: np.dtype[Any]) -> list[Entry]:
    """Return the entries of the observation of an env, which have at least one number."""
    if not isinstance(env.observation_space, spaces.Space):
        raise ValueError(
            f"the observation_space of {name} is {shown(env.observation_space)}, not a space of "
            "Gymnasium: set it in its __init__"
        )
    entries = [Entry(name, path, leaf, floats) for path, leaf in leaves(env.observation_space)]
    if all(0 in entry.given for entry in entries):
        raise ValueError(
            f"the observation_space of {name} is {env.observation_space}, which has no numbers; "
            "observe at least one, such as a constant"
        )
    return entries


def _check_same_spaces(name: str, row: int, env: Env, first: Env) -> None:
    """Raise a `ValueError` for an env whose spaces are not those of the first one."""
    for which in ("action_space", "observation_space"):
        if getattr(env, which) != getattr(first, which):
            raise ValueError(
                f"the {which} of {name} is {getattr(env, which)} in row {row}, but "
                f"{getattr(first, which)} in row 0: all envs of a run need the same spaces"
            )
