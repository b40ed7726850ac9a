"""Gymnasium envs as one batched TorchRL env, with controllers beside them.

TorchRL has a wrapper of its own. This one is seeded episode by episode, so that it can go on after
an interruption (see `SeededRows`), names what is missing in one sentence, and lets controllers act
beside the env that need the env itself, not only its observation.
"""

import importlib
import inspect
import math
import pkgutil
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, MutableMapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any
from weakref import WeakValueDictionary

import gymnasium
import numpy as np
import torch
from gymnasium import error as errors
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from coil_rl.envs.env_batch import SeededRows
from coil_rl.envs.gate import (
    LIMIT,
    OWN_LIMITS,
    EnvGate,
    ForeignError,
    acting,
    foreign,
    plain_array,
    predicts,
    shortened,
    shown,
)
from coil_rl.envs.gymnasium_spaces import (
    Entry,
    action_spec,
    check_action_space,
    has_whole_numbers,
    leaves,
    lowest_choices,
)
from coil_rl.envs.limits import check_range
from coil_rl.envs.workers import AUTO, Entries, Workers, choose, timed

# What an error about a missing package mentions, and the extra of coil-rl that installs it.
EXTRAS = {"box2d": "gym", "pygame": "gym", "mujoco": "mujoco", "minigrid": "babyai"}
MOST_WORKERS = 256
RESERVED = ("action", "reward", "done", "terminated", "truncated", "info", "controller", "next")

Env = gymnasium.Env[Any, Any]


class GymnasiumEnv(SeededRows):
    """Gymnasium envs as one env of batch size [num_envs].

    They are stepped one after the other in this process, or in several ones at once (`workers`).

    Reads `action`. Writes `reward`, `done`, `terminated`, `truncated` [B, 1] and the observation:
    `observation`, or one entry a key of a Dict space (nested as there; a Tuple has the keys "0",
    "1", ...). A Box is a tensor of `dtype`, but uint8 stays uint8; Discrete and MultiDiscrete are
    one-hot vectors of `dtype`, MultiBinary is one of 0 and 1; texts are left out. Actions are
    bounded or unbounded for a Box (and clamped to its bounds), indices from 0 for Discrete [B],
    MultiDiscrete [B, n] and a Box of a few whole numbers [B, n], and 0 or 1 for MultiBinary.

    A row whose episode is over stays as it is, with reward 0, until it is reset. A restored state
    goes on to the bit if the env is deterministic, see `SeededRows`. `rate` is the steps per second
    at which the env is drawn, NaN if it does not say.

    Args:
        id: registered name; "MODULE:NAME" imports the module first. Or a maker of an env: a class
            or function, or the "MODULE:NAME" of one.
        num_envs: B, number of rows.
        options: keyword arguments of `gymnasium.make`, or of the maker.
        wrappers: callables that take an env and return one, applied in this order.
        max_steps: steps after which an episode is truncated, instead of the registered number. An
            env that names no number at all is truncated after 1,000, with a warning.
        seed: of the draw of the episodes' seeds, at least 0.
        first_seed: row i begins all its episodes with the seed `first_seed + i % cases`; None to
            draw the seeds.
        cases: number of different episodes, by default `num_envs`; needs `first_seed`.
        info: names of numbers in Gymnasium's info to write as ("info", NAME) [B, 1], 0 where
            missing.
        controllers: by name, a controller or its import path "PACKAGE.MODULE:THING". A class gets
            one object an env, `THING(env)`, with a method `act(observation)` and, if it wants,
            `reset()`, called at the start of an episode; a function is called as `THING(env,
            observation)`. Either may be a `functools.partial`. Its action for the present
            observation is written as ("controller", NAME), not clamped, in the env's own
            numbering; after a termination it is the last one. An object with `act`, or a trained
            model with `predict`, is used as it is.
        fresh: whether every episode has a new env, for those whose reset leaves something of the
            past. BipedalWalker is one: without `fresh`, its episodes depend on the seed and, a
            little, on those before.
        render: whether `render` gives pictures, of the rows that begin with the first of `cases`
            different episodes.
        workers: number of processes over which the rows are spread, 0 for none besides this one;
            "auto" for as many as there are cores if a timed step is long enough. The digits are
            the same.
        device: of all tensors.
        dtype: of all floating-point tensors.

    Raises:
        ValueError: if the env cannot be made, has a space that is not supported or an entry with a
            reserved name or bounds that leave no choice, or if a controller cannot be imported.
        ForeignError: at a reset or a step, for what the env or a controller raises or returns that
            does not fit; see `coil_rl.envs.gate`.

    Example:
        >>> from coil_rl import GymnasiumEnv
        >>> env = GymnasiumEnv("CartPole-v1", num_envs=4)
        >>> env.rollout(3, break_when_any_done=False)["next", "observation"].shape
        torch.Size([4, 3, 4])
    """

    remedy = "; fresh=true helps where a reset leaves something of the past"

    def __init__(
        self,
        id: str | Callable[..., Env],
        num_envs: int = 1,
        *,
        options: Mapping[str, Any] | None = None,
        wrappers: Sequence[Callable[[Env], Env]] = (),
        max_steps: int | None = None,
        seed: int = 0,
        first_seed: int | None = None,
        cases: int | None = None,
        info: Sequence[str] = (),
        controllers: Mapping[str, str | Callable[..., Any]] | None = None,
        fresh: bool = False,
        render: bool = False,
        workers: int | str = 0,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        check_range(1, num_envs=num_envs, max_steps=1 if max_steps is None else max_steps)
        _check_workers(workers)
        makers = {
            name: resolved_controller(name, thing) for name, thing in (controllers or {}).items()
        }
        settings = dict(options or {})
        if max_steps is not None:
            settings["max_episode_steps"] = max_steps
        maker = _maker(id)
        make = partial(_make, maker, wrappers, settings)
        drawn, every = make, cases or num_envs
        self.shown = render and "rgb_array" in _metadata(make(), "render_modes", ())
        if self.shown:
            drawn = partial(_make, maker, wrappers, settings | {"render_mode": "rgb_array"})
        name, self.floats = _name(maker), torch.empty(0, dtype=dtype).numpy().dtype

        def make_row(number: int) -> _Row:
            return _Row(make if number % every else drawn, makers, fresh, name, number, self.floats)

        self.make_row, self.asked = make_row, workers
        self.kind = f"{settings} {wrappers} {makers}"
        self.workers: Workers | None = None
        self.info = tuple(info)
        # With processes, row 0 of this one only says what the spaces are.
        self.held = _Rows(make_row, range(1 if workers else num_envs), self.info)
        self.parts: list[Entries] = []  # of all rows, as the processes returned them
        super().__init__(self.held.rows, num_envs, seed, first_seed, cases, device)
        env = self.held.rows[0].gate.env
        self.rate = _rate(env)
        self.space, self.entries = env.action_space, self.held.entries
        check_action_space(name, self.space)
        lowest = torch.as_tensor(lowest_choices(self.space)).reshape(-1)
        self.first_choices = lowest if lowest.any() else None  # the lowest numbers, if not 0
        self._declare_specs(name, makers, dtype)

    def _declare_specs(self, id: str, controllers: Iterable[str], dtype: torch.dtype) -> None:
        action, number = action_spec(id, self.space, dtype), Unbounded(1, dtype=dtype)
        observation = Composite()
        for entry in self.entries:
            name = entry.key[0]
            if name in RESERVED:
                raise ValueError(
                    f"the observation of {id} has an entry {name!r}: rename it with a wrapper"
                )
            observation[entry.key] = entry.spec
        for name in self.info:
            observation["info", name] = number.clone()
        for name in controllers:
            # Advice is written as given, and may be out of bounds.
            advice = action.clone()
            if isinstance(action, Bounded):
                advice = Unbounded(action.shape, dtype=dtype)
            elif self.first_choices is not None:
                advice = Unbounded(action.shape, dtype=action.dtype)
            observation["controller", name] = advice
        flag = Binary(1, dtype=torch.bool)
        ends = Composite({name: flag.clone() for name in ("done", "terminated", "truncated")})
        self.observation_spec = self._of_all_rows(observation)
        self.done_spec = self._of_all_rows(ends)
        self.action_spec = self._of_all_rows(action)
        self.reward_spec = self._of_all_rows(number)

    def _of_all_rows(self, spec: TensorSpec) -> TensorSpec:
        """Return the spec of a batch from that of one row."""
        return spec.to(self.device).expand(*self.batch_size, *spec.shape)

    @property
    def meanings(self) -> Any:
        """What the env says about its entries, see `coil_rl.envs.meanings`."""
        return getattr(self.rows[0].gate.env.unwrapped, "meanings", None)

    def render(self, row: int = 0) -> NDArray[np.uint8] | None:
        """Return a picture, [height, width, 3]; None if there are none.

        Args:
            row: one that begins with the first of the different episodes.
        """
        if not self.shown:
            return None
        try:
            return self.held.picture(row) if self.workers is None else self.workers.picture(row)
        except ForeignError as error:
            self.shown = False
            cause = error if error.__cause__ is None else error.__cause__
            warnings.warn(f"no pictures of the env: {shortened(str(cause))}", stacklevel=2)
            return None

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close all envs."""
        self.held.close()
        if self.workers is not None:
            self.workers.close()
        super().close(raise_if_closed=raise_if_closed)

    def begin_rows(self, seeds: Mapping[int, int], actions: Mapping[int, Sequence[Any]]) -> None:
        """Begin episodes, see `SeededRows`; the rows are made before the first one."""
        if not self.parts:
            self._place_rows()
        if self.workers is None:
            self.held.begin_rows(seeds, actions)
            self.parts = [self.held.entries_of_rows()]
        else:
            self.parts = self.workers.begin(seeds, actions)

    def step_rows(self, actions: Any) -> None:
        """Take a step in all rows, see `SeededRows`."""
        if self.workers is None:
            self.held.step_rows(actions)
            self.parts = [self.held.entries_of_rows()]
        else:
            self.parts = self.workers.step(actions)

    def _place_rows(self) -> None:
        """Decide in which processes the rows are, and make them there."""
        count = self.batch_size[0]
        if count == len(self.held.rows):
            return
        like = self.held.rows[0]
        make = partial(_Rows, self.make_row, info=self.info, like=like.gate.env)
        seconds = partial(timed, make, self.space.sample)
        number = choose(self.asked, count, seconds, like.name, self.kind)
        if number:
            self.workers = Workers(make, count, number, like.name)
        else:
            self.held.extend(self.make_row, count)

    def encode(self, observation: Any, *, first: bool) -> TensorDict:
        """Return the entries of an env of one row for an observation that comes from elsewhere.

        Controllers beside the env are asked too; the env itself is not stepped.

        Args:
            observation: as a Gymnasium env of this kind gives it.
            first: whether it is the first one of an episode.
        """
        (row,) = self.rows
        row.observe(observation, first=first)
        self.parts = [self.held.entries_of_rows()]
        return self._output(stepped=not first)

    def decode(self, actions: torch.Tensor) -> Any:
        """Return the action of an env of one row as a Gymnasium env of this kind takes it."""
        (action,) = self._decode(actions.cpu().numpy())
        return action

    def _decode(self, actions: NDArray[Any]) -> NDArray[Any]:
        if isinstance(self.space, spaces.Box) and not has_whole_numbers(self.space):
            if not np.isfinite(actions).all():
                raise ForeignError(
                    f"the action for the env {self.rows[0].gate.name} holds a number that is not "
                    "finite: the policy or its guide gave none"
                )
            typed = actions.astype(self.space.dtype)
            if not self.space.shape:
                typed = typed[..., 0]
            return np.clip(typed, self.space.low, self.space.high)
        numbered = actions + lowest_choices(self.space)
        return numbered.astype(self.space.dtype) if has_whole_numbers(self.space) else numbered

    def _output(self, *, stepped: bool) -> TensorDict:
        tensors: dict[Any, torch.Tensor] = {}
        for key in self.parts[0]:
            if key == "reward" and not stepped:
                continue
            parts = [part[key] for part in self.parts]
            value = torch.from_numpy(np.concatenate(parts) if len(parts) > 1 else parts[0])
            if key[0] == "controller":
                spec = self.observation_spec[key]
                value = value.to(spec.dtype).reshape(spec.shape)
            tensors[key] = value
        data = TensorDict(tensors, self.batch_size)
        return data if self.device is None or self.device.type == "cpu" else data.to(self.device)


class _Rows:
    """Rows that are stepped one after the other in one process; see `coil_rl.envs.workers.Shard`.

    Args:
        make_row: makes a row by its number.
        numbers: of the rows.
        info: names of numbers in Gymnasium's info.
        like: an env whose spaces those of all rows must be; by default that of the first row.
    """

    def __init__(
        self,
        make_row: Callable[[int], "_Row"],
        numbers: range,
        info: Sequence[str],
        like: Env | None = None,
    ) -> None:
        self.info = tuple(info)
        self.rows = [make_row(numbers[0])]
        first = self.rows[0]
        self.like = first.gate.env if like is None else like
        self.entries = _entries(first.name, self.like, first.dtype)
        self._fit(first)
        self.extend(make_row, len(numbers), numbers[0])

    def extend(self, make_row: Callable[[int], "_Row"], count: int, start: int = 0) -> None:
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

    def _fit(self, row: "_Row") -> None:
        row.entries = self.entries
        if row.gate.env is not self.like:
            _check_same_spaces(row.name, row.number, row.gate.env, self.like)

    def begin_rows(self, seeds: Mapping[int, int], actions: Mapping[int, Sequence[Any]]) -> None:
        """Begin episodes, and take some actions in each."""
        for row, seed in seeds.items():
            self.rows[row].begin(seed)
            for action in actions.get(row, ()):
                self.rows[row].step(action)

    def step_rows(self, actions: Any) -> None:
        """Take a step in all rows."""
        for row, action in zip(self.rows, actions, strict=True):
            row.step(action)

    def entries_of_rows(self) -> Entries:
        """Return the entries of all rows, [rows, ...], and their rewards."""
        rows, count = self.rows, len(self.rows)
        ends = np.empty((2, count, 1), dtype=bool)
        rewards = np.empty((count, 1), dtype=rows[0].dtype)
        observed = [np.empty((count, *entry.given), entry.dtype) for entry in self.entries]
        for number, row in enumerate(rows):
            ends[0, number], ends[1, number] = row.terminated, row.truncated
            rewards[number] = row.reward
            for array, value in zip(observed, row.values, strict=True):
                array[number] = value
        found: Entries = {
            "terminated": ends[0],
            "truncated": ends[1],
            "done": ends[0] | ends[1],
            "reward": rewards,
        }
        for entry, array in zip(self.entries, observed, strict=True):
            found[entry.key if len(entry.key) > 1 else entry.key[0]] = array
        for name in self.info:
            numbers = np.array([row.number_of(name) for row in rows], dtype=rows[0].dtype)
            found["info", name] = numbers.reshape(-1, 1)
        for name in rows[0].controllers:
            found["controller", name] = np.array([row.advice[name] for row in rows])
        return found

    def picture(self, row: int) -> NDArray[np.uint8]:
        """Return a picture of a row."""
        return self.rows[row].gate.render()

    def close(self) -> None:
        """Close all envs."""
        for row in self.rows:
            row.gate.close()


class _Row:
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
        limit = None if _has_limit(env) else LIMIT
        self.gate = EnvGate(env, self.name, self.number, self.dtype, limit)
        self.controllers = {
            name: controller_of(name, maker, env) for name, maker in self.makers.items()
        }

    def begin(self, seed: int) -> None:
        if self.fresh:
            self.gate.close()
            _alive.pop(id(self.gate.env.unwrapped), None)
            self._open()
        self.observation, self.info = self.gate.reset(seed)
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
        if self.terminated or self.truncated:
            self.reward = 0.0
            return
        self.observation, self.reward, self.terminated, self.truncated, self.info = self.gate.step(
            action
        )
        self.values = self.gate.read(self.observation, self.entries)
        if not self.terminated:
            self._advise()

    def number_of(self, name: str) -> float:
        """Return a number of info, 0 where it is missing."""
        value = self.info.get(name, 0)
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
            with foreign(f"the controller {name} beside {self.gate.place}", "it"):
                advice = act(self.observation)
            self.advice[name] = self._fitted(name, advice)

    def _fitted(self, name: str, advice: Any) -> NDArray[Any]:
        """Return the action of a controller as an array, in the env's own numbering."""
        with self.gate.placed():
            return fitted_action(name, advice, self.gate.env.action_space)


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


def _check_workers(workers: int | str) -> None:
    """Raise a `ValueError` for what is no number of processes."""
    whole = isinstance(workers, int) and not isinstance(workers, bool)
    if workers != AUTO and not (whole and 0 <= int(workers) <= MOST_WORKERS):
        raise ValueError(
            f"workers={workers} must be auto or a whole number from 0 to {MOST_WORKERS}"
        )


# The envs of all rows of this process, to find one that two rows would share.
_alive: MutableMapping[int, Any] = WeakValueDictionary()


def _metadata(env: Env, key: str, default: Any) -> Any:
    """Return an entry of the metadata of an env, which may have none."""
    metadata = getattr(env, "metadata", None)
    return (metadata.get(key) or default) if isinstance(metadata, Mapping) else default


def _rate(env: Env) -> float:
    """Return the pictures per second of an env; NaN if it does not say."""
    rate = _metadata(env, "render_fps", math.nan)
    return float(rate) if isinstance(rate, (int, float)) else math.nan


def _has_limit(env: Env) -> bool:
    """Return whether an env names the largest number of steps of an episode."""
    spec = getattr(env, "spec", None)
    if getattr(spec, "max_episode_steps", None):
        return True
    layer: Any = env
    while isinstance(layer, gymnasium.Wrapper):
        if isinstance(layer, gymnasium.wrappers.TimeLimit):
            return True
        layer = layer.env
    return any(isinstance(getattr(layer, name, None), int) for name in OWN_LIMITS)


def _entries(name: str, env: Env, floats: np.dtype[Any]) -> list[Entry]:
    """Return the entries of the observation of an env."""
    if not isinstance(env.observation_space, spaces.Space):
        raise ValueError(
            f"the observation_space of {name} is {shown(env.observation_space)}, not a space of "
            "Gymnasium: set it in its __init__"
        )
    return [Entry(name, path, leaf, floats) for path, leaf in leaves(env.observation_space)]


def _check_same_spaces(name: str, row: int, env: Env, first: Env) -> None:
    """Raise a `ValueError` for an env whose spaces are not those of the first one."""
    for which in ("action_space", "observation_space"):
        if getattr(env, which) != getattr(first, which):
            raise ValueError(
                f"the {which} of {name} is {getattr(env, which)} in row {row}, but "
                f"{getattr(first, which)} in row 0: all envs of a run need the same spaces"
            )


def _maker(id: str | Callable[..., Env]) -> str | Callable[..., Env]:
    """Return the maker that MODULE:NAME names, if it is no registered name; else `id` itself."""
    if not isinstance(id, str) or ":" not in id:
        return id
    module, _, name = id.partition(":")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError:
        return id  # Gymnasium says what is wrong
    return found if callable(found) and name not in gymnasium.registry else id


def _name(maker: str | Callable[..., Env]) -> str:
    return maker if isinstance(maker, str) else getattr(maker, "__qualname__", repr(maker))


def _make(
    maker: str | Callable[..., Env],
    wrappers: Sequence[Callable[[Env], Env]],
    settings: Mapping[str, Any],
) -> Env:
    """Return an env in its wrappers; a `ValueError` says why it cannot be made."""
    name = _name(maker)
    try:
        if isinstance(maker, str):
            env: Env = gymnasium.make(maker, **{"disable_env_checker": True, **settings})
        else:
            env = _called(maker, settings)
        for wrapper in wrappers:
            env = wrapper(env)
        missing = [
            which
            for which in ("action_space", "observation_space")
            if isinstance(env, gymnasium.Env) and getattr(env, which, None) is None
        ]
    except (Exception, SystemExit) as error:
        raise ValueError(f"the env {name} cannot be made: {_reason(name, error)}") from error
    if not isinstance(env, gymnasium.Env):
        raise ValueError(
            f"the env {name} is {shown(env)}, not an env of Gymnasium: derive its class from "
            "gymnasium.Env"
        )
    if missing:
        raise ValueError(f"the env {name} has no {missing[0]}: set it in its __init__")
    _check_statistics(env, name)
    return env


def _check_statistics(env: Env, name: str) -> None:
    """Refuse wrappers that normalise by statistics, which a new env of an evaluation lacks."""
    layer: Any = env
    while layer is not None:
        kinds = {kind.__name__ for kind in type(layer).__mro__}
        if any(kind.startswith("NormalizeObservation") for kind in kinds):
            raise ValueError(
                f"the env {name} has the wrapper {type(layer).__name__}, whose statistics an "
                "evaluation begins anew; leave it out and give learner.normalise=true"
            )
        if any(kind.startswith("NormalizeReward") for kind in kinds):
            raise ValueError(
                f"the env {name} has the wrapper {type(layer).__name__}, which changes the returns "
                "that a table shows by statistics of its own; leave it out, returns are the env's "
                "own"
            )
        layer = getattr(layer, "env", None)


def _called(maker: Callable[..., Env], settings: Mapping[str, Any]) -> Env:
    """Return the env of a maker, with the settings that `gymnasium.make` would handle itself."""
    options = dict(settings)
    steps = options.pop("max_episode_steps", None)
    parameters = inspect.signature(maker).parameters.values()
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    if not takes_any and "render_mode" not in [parameter.name for parameter in parameters]:
        options.pop("render_mode", None)
    env = maker(**options)
    return env if steps is None else gymnasium.wrappers.TimeLimit(env, steps)


def _reason(id: str, error: BaseException) -> str:
    """Return in a few words why an env cannot be made, with a remedy where one is known."""
    extra = next((EXTRAS[name] for name in EXTRAS if name in f"{id} {error}".lower()), None)
    if extra and isinstance(error, (errors.DependencyNotInstalled, ModuleNotFoundError)):
        return f"a package is not installed: python -m pip install 'coil-rl[{extra}]'"
    if not isinstance(error, errors.Error):  # of the env itself
        text = shortened(re.split(r" was raised from", str(error).strip())[0])
        return f"it raised {type(error).__name__}: {text}" if text else type(error).__name__
    first_line = re.split(r"\n| was raised from", str(error).strip())[0].rstrip(".")
    if not id:
        return "env.id is empty; write env.id=MODULE:NAME, or the id of a registered env"
    if not isinstance(error, (errors.NameNotFound, errors.NamespaceNotFound)):
        return first_line or type(error).__name__
    module, _, name = id.rpartition(":")
    if module:
        return f"{module} has no env {name}, and registers none of this name"
    # Gymnasium may have a suggestion of its own: "Did you mean ...".
    if "mean" in first_line:
        return first_line
    return f"{first_line}; if a package registers it, write PACKAGE:{id}"


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
