"""Gymnasium envs as one batched TorchRL env, with controllers beside them.

TorchRL has a wrapper of its own. This one is seeded episode by episode, so that it can go on after
an interruption (see `SeededRows`), names what is missing in one sentence, and lets controllers act
beside the env that need the env itself, not only its observation.
"""

import importlib
import inspect
import pkgutil
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import error as errors
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded

from coil_rl.envs.env_batch import SeededRows
from coil_rl.envs.gymnasium_spaces import (
    Entry,
    action_spec,
    has_whole_numbers,
    leaves,
    lowest_choices,
)
from coil_rl.envs.limits import check_range

# What an error about a missing package mentions, and the extra of coil-rl that installs it.
EXTRAS = {"box2d": "gym", "pygame": "gym", "mujoco": "mujoco", "minigrid": "babyai"}
RESERVED = ("action", "reward", "done", "terminated", "truncated", "info", "controller", "next")

Env = gymnasium.Env[Any, Any]


class GymnasiumEnv(SeededRows):
    """Gymnasium envs as one env of batch size [num_envs].

    They are stepped one after the other in this process.

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
        id: registered name; "MODULE:NAME" imports the module first. Or a maker of an env: a class or
            function, or the "MODULE:NAME" of one.
        num_envs: B, number of rows.
        options: keyword arguments of `gymnasium.make`, or of the maker.
        wrappers: callables that take an env and return one, applied in this order.
        max_steps: steps after which an episode is truncated, instead of the registered number.
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
            numbering; after a termination it is the last one.
        fresh: whether every episode has a new env, for those whose reset leaves something of the
            past. BipedalWalker is one: without `fresh`, its episodes depend on the seed and, a
            little, on those before.
        render: whether `render` gives pictures.
        device: of all tensors.
        dtype: of all floating-point tensors.

    Raises:
        ValueError: if the env cannot be made, has a space that is not supported or an entry with a
            reserved name, or if a controller cannot be imported.

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
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        check_range(1, num_envs=num_envs, max_steps=1 if max_steps is None else max_steps)
        makers = {name: _resolve(name, thing) for name, thing in (controllers or {}).items()}
        settings = dict(options or {})
        if max_steps is not None:
            settings["max_episode_steps"] = max_steps
        maker = _maker(id)
        makes = [partial(_make, maker, wrappers, settings)] * num_envs
        self.shown = render and "rgb_array" in makes[0]().metadata.get("render_modes", ())
        if self.shown:
            makes[0] = partial(_make, maker, wrappers, settings | {"render_mode": "rgb_array"})
        rows = [_Row(make, makers, fresh) for make in makes]
        super().__init__(rows, seed, first_seed, cases, device)
        env = rows[0].env
        self.info = tuple(info)
        self.floats = torch.empty(0, dtype=dtype).numpy().dtype
        self.rate = float(env.metadata.get("render_fps") or "nan")
        self.space = env.action_space
        first = torch.as_tensor(lowest_choices(self.space)).reshape(-1)
        self.first_choices = first if first.any() else None  # the lowest numbers, if not 0
        name = _name(maker)
        self.entries = [
            Entry(name, path, leaf, self.floats) for path, leaf in leaves(env.observation_space)
        ]
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

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of row 0, [height, width, 3]; None if there are none."""
        try:
            return self.rows[0].env.render() if self.shown else None
        except Exception as error:  # a missing package or display; each library raises its own
            self.shown = False
            warnings.warn(f"no pictures of the env: {error}", stacklevel=2)
            return None

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close all envs."""
        for row in self.rows:
            row.env.close()
        super().close(raise_if_closed=raise_if_closed)

    def encode(self, observation: Any, *, first: bool) -> TensorDict:
        """Return the entries of an env of one row for an observation that comes from elsewhere.

        Controllers beside the env are asked too; the env itself is not stepped.

        Args:
            observation: as a Gymnasium env of this kind gives it.
            first: whether it is the first one of an episode.
        """
        (row,) = self.rows
        row.observe(observation, first=first)
        return self._output(stepped=not first)

    def decode(self, actions: torch.Tensor) -> Any:
        """Return the action of an env of one row as a Gymnasium env of this kind takes it."""
        (action,) = self._decode(actions.cpu().numpy())
        return action

    def _decode(self, actions: NDArray[Any]) -> NDArray[Any]:
        if isinstance(self.space, spaces.Box) and not has_whole_numbers(self.space):
            typed = actions.astype(self.space.dtype)
            if not self.space.shape:
                typed = typed[..., 0]
            return np.clip(typed, self.space.low, self.space.high)
        numbered = actions + lowest_choices(self.space)
        return numbered.astype(self.space.dtype) if has_whole_numbers(self.space) else numbered

    def _output(self, *, stepped: bool) -> TensorDict:
        rows = self.rows
        terminated = np.array([[row.terminated] for row in rows], dtype=bool)
        truncated = np.array([[row.truncated] for row in rows], dtype=bool)
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        data = TensorDict({}, self.batch_size)
        for name, end in ends.items():
            data[name] = torch.from_numpy(end)
        if stepped:
            data["reward"] = self._numbers([row.reward for row in rows])
        for entry in self.entries:
            data[entry.key] = torch.from_numpy(entry([row.observation for row in rows]))
        for name in self.info:
            try:
                data["info", name] = self._numbers([row.info.get(name, 0) for row in rows])
            except (TypeError, ValueError) as error:
                raise ValueError(f"info entry {name!r} is not a number") from error
        for name in rows[0].controllers:
            advice = torch.from_numpy(np.array([row.advice[name] for row in rows]))
            spec = self.observation_spec["controller", name]
            data["controller", name] = advice.to(spec.dtype).reshape(spec.shape)
        return data if self.device is None or self.device.type == "cpu" else data.to(self.device)

    def _numbers(self, values: list[Any]) -> torch.Tensor:
        return torch.from_numpy(np.array(values, dtype=self.floats).reshape(-1, 1))


class _Row:
    """One Gymnasium env and the controllers beside it; see `rows` of `SeededRows`."""

    def __init__(
        self, make: Callable[[], Env], makers: Mapping[str, Callable[..., Any]], fresh: bool
    ) -> None:
        self.make, self.makers, self.fresh = make, makers, fresh
        self.advice: dict[str, NDArray[Any]] = {}
        self._open()

    def _open(self) -> None:
        self.env = self.make()
        self.controllers = {
            name: _controller(name, maker, self.env) for name, maker in self.makers.items()
        }

    def begin(self, seed: int) -> None:
        if self.fresh:
            self.env.close()
            self._open()
        self.observation, self.info = self.env.reset(seed=seed)
        self.reward, self.terminated, self.truncated = 0.0, False, False
        for _, reset in self.controllers.values():
            reset()
        self._advise()

    def observe(self, observation: Any, *, first: bool) -> None:
        """Take an observation that comes from elsewhere."""
        if not hasattr(self, "observation"):
            self.begin(0)  # controllers may read what an env has after its reset only
        self.observation, self.reward, self.info = observation, 0.0, {}
        if first:
            for _, reset in self.controllers.values():
                reset()
        self._advise()

    def step(self, action: Any) -> None:
        if self.terminated or self.truncated:
            self.reward = 0.0
            return
        self.observation, reward, self.terminated, self.truncated, self.info = self.env.step(action)
        self.reward = float(reward)
        if not self.terminated:
            self._advise()

    def _advise(self) -> None:
        space = self.env.action_space
        for name, (act, _) in self.controllers.items():
            advice = np.asarray(act(self.observation))
            if has_whole_numbers(space):
                whole = advice.astype(space.dtype)
                fits = bool((whole == advice).all()) and space.contains(whole)
            elif isinstance(space, spaces.Box):
                fits = advice.shape == space.shape and np.isfinite(advice).all()
            else:
                fits = space.contains(advice)
            if not fits:
                raise ValueError(
                    f"controller {name} gave {advice.tolist()}, not an action of {space}"
                )
            self.advice[name] = advice


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
    try:
        if isinstance(maker, str):
            env: Env = gymnasium.make(maker, **{"disable_env_checker": True, **settings})
        else:
            env = _called(maker, settings)
    except (errors.Error, ImportError, TypeError, AssertionError, OSError, ValueError) as error:
        name = _name(maker)
        raise ValueError(f"the env {name} cannot be made: {_reason(name, error)}") from error
    for wrapper in wrappers:
        env = wrapper(env)
    _check_statistics(env, _name(maker))
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


def _reason(id: str, error: Exception) -> str:
    """Return in a few words why an env cannot be made, with a remedy where one is known."""
    extra = next((EXTRAS[name] for name in EXTRAS if name in f"{id} {error}".lower()), None)
    if extra and isinstance(error, (errors.DependencyNotInstalled, ModuleNotFoundError)):
        return f"a package is not installed: python -m pip install 'coil-rl[{extra}]'"
    first_line = re.split(r"\n| was raised from", str(error).strip())[0].rstrip(".")
    unknown = isinstance(error, (errors.NameNotFound, errors.NamespaceNotFound))
    # Gymnasium may have a suggestion of its own: "Did you mean ...".
    if unknown and "mean" not in first_line:
        return f"{first_line}; if a package registers it, write PACKAGE:{id}"
    return first_line or type(error).__name__


def _resolve(name: str, thing: str | Callable[..., Any]) -> Callable[..., Any]:
    """Return a controller by its import path PACKAGE.MODULE:THING."""
    if not isinstance(thing, str):
        return thing
    try:
        return pkgutil.resolve_name(thing)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"controller {name}: {thing!r} cannot be imported ({error}); write PACKAGE.MODULE:THING"
        ) from error


def _controller(
    name: str, maker: Callable[..., Any], env: Env
) -> tuple[Callable[[Any], Any], Callable[[], Any]]:
    """Make a controller for an env.

    Args:
        name: of the controller, for messages.
        maker: a class, a function or a `functools.partial` of either.
        env: beside which the controller acts.

    Returns:
        What gives the action for an observation, and what to call at the start of an episode.
    """
    if not inspect.isclass(getattr(maker, "func", maker)):
        return partial(maker, env), lambda: None
    try:
        controller = maker(env)
    except TypeError as error:
        raise ValueError(f"controller {name} cannot be made with its env: {error}") from error
    if not callable(getattr(controller, "act", None)):
        raise ValueError(
            f"controller {name}: {type(controller).__name__} needs a method act(observation)"
        )
    return controller.act, getattr(controller, "reset", lambda: None)
