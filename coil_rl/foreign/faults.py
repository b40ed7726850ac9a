"""The gate around code of other people: their envs and their controllers.

What such code returns is checked here before anything computes with it, at every step. So a fault
in it is one sentence that names the env or the controller, the row, the seed of the episode and the
step, and says what came and what was expected. Arrays are copied, because many envs return one
buffer at every step.
"""

from __future__ import annotations

import copy
import inspect
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from numbers import Real
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

LIMIT = 1_000  # steps; of an episode of an env that has no wrapper which ends it
SET_LIMIT = "env.max_steps=NUMBER sets another limit"
# Attributes in which envs keep the largest number of steps of an episode themselves.
OWN_LIMITS = ("max_steps", "max_episode_steps", "_max_episode_steps", "horizon")


def limit_by_attributes(env: Any, names: Sequence[str] = OWN_LIMITS) -> int:
    """Return the number of steps after which an episode is truncated, unless the env ends it.

    An attribute may be another thing than it seems, such as the horizon of a predictive controller.
    So it only makes the limit longer.

    Args:
        env: of any library.
        names: of the attributes.
    """
    values = (getattr(env, name, None) for name in names)
    numbers = [value for value in values if isinstance(value, Real) and math.isfinite(value)]
    return max([LIMIT, *(math.ceil(float(number)) for number in numbers)])


def warn_of_limit(name: str, limit: int, wrapper: str, remedy: str) -> None:
    """Warn that the episodes of an env are truncated.

    Args:
        name: of the env.
        limit: the number of steps.
        wrapper: what could have ended the episode.
        remedy: how to set another limit.
    """
    warnings.warn(
        f"an episode of the env {name} did not end within {limit:,} steps, and no {wrapper} ends "
        f"it: episodes are truncated there ({remedy})",
        stacklevel=3,
    )


class ForeignError(ValueError):
    """A fault in an env or controller of somebody else, as one sentence."""

    outside: ClassVar[bool] = True  # the cause is not in this program


@contextmanager
def foreign(name: str, call: str) -> Iterator[None]:
    """Turn what the code of somebody else raises into a `ForeignError`.

    Args:
        name: of the env or controller, as in "the env Plant".
        call: what it was asked, such as "step".
    """
    try:
        yield
    except ForeignError:
        raise
    except (Exception, SystemExit) as error:
        # A tail such as ": " without a text would say nothing.
        text = shortened(str(error)) or "without a text"
        raise ForeignError(f"{name}: {call} raised {type(error).__name__}: {text}") from error


def shortened(text: str) -> str:
    """Return a text on one line, of at most 200 characters."""
    return _cut(text, 200)


def _cut(text: str, most: int) -> str:
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
    return _cut(text, 80)


def plain_array(value: Any, what: str) -> NDArray[Any]:
    """Return numbers as an array.

    Args:
        value: a number, a nested list of numbers, an array or a tensor.
        what: name of the value, for the message.

    Raises:
        ForeignError: for anything else.
    """
    if type(value) is np.ndarray and value.dtype.kind in "biuf":
        return value
    try:
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
    except Exception as error:
        raise ForeignError(f"{what} is {shown(value)}, not an array of numbers") from error
    if array.dtype.kind not in "biuf" or np.ma.is_masked(value):
        raise ForeignError(f"{what} is {shown(value)}, not an array of numbers")
    return array


def number(value: Any, what: str, dtype: np.dtype[Any]) -> float:
    """Return one finite number.

    Args:
        value: what came.
        what: name of the number, for the message.
        dtype: in which the number must be finite.

    Raises:
        ForeignError: for None, a text, an array with a dimension, a complex number, and for a
            number that is not finite.
    """
    plain = isinstance(value, (float, int))
    if not plain and (isinstance(value, (str, bytes)) or np.ndim(value) > 0):
        raise ForeignError(f"{what} is {shown(value)}, not one number")
    try:
        result = float(value)
    except Exception as error:
        raise ForeignError(f"{what} is {shown(value)}, not one number") from error
    largest = _largest(dtype)
    if not -largest <= result <= largest:
        raise ForeignError(f"{what} is {result}, not a finite number of {dtype}")
    return result


@cache
def _largest(dtype: np.dtype[Any]) -> float:
    """Return the largest number of a dtype."""
    return float(np.finfo(dtype).max)


def flag(value: Any, what: str) -> bool:
    """Return a flag.

    Args:
        value: what came.
        what: name of the flag, for the message.

    Raises:
        ForeignError: for anything but True, False, 1 and 0.
    """
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    single = np.ndim(value) == 0 and not isinstance(value, (str, bytes))
    if not single or value is None or value not in (0, 1):
        raise ForeignError(f"{what} is {shown(value)}, not True or False")
    return bool(value)


def action_array(value: Any) -> NDArray[Any]:
    """Return an action of a controller as an array of at least one dimension.

    Args:
        value: what the controller returned.

    Raises:
        ForeignError: for what is not numbers, or not finite; also for an action with a state, as
            controllers of some libraries return them.
    """
    if isinstance(value, tuple) and any(np.ndim(part) or part is None for part in value[:2]):
        raise ForeignError(
            f"the action is the tuple {shown(value)}; return the action alone, without a state"
        )
    array = np.atleast_1d(plain_array(value, "the action"))
    if array.dtype == np.bool_:
        array = array.astype(np.int64)
    if not np.isfinite(array).all():
        raise ForeignError(f"the action is {shown(array)}, which is not finite")
    return array


class EnvGate:
    """A Gymnasium env from outside this project; what it returns is checked at every call.

    Args:
        env: the env.
        name: of the env, for messages.
        row: its number in a batch, for messages.
        dtype: of numbers; rewards must be finite in it.
        limit: steps after which an episode is truncated, with a warning; None for no limit.
    """

    def __init__(
        self, env: Any, name: str, row: int, dtype: np.dtype[Any], limit: int | None = None
    ) -> None:
        self.env, self.name, self.row = env, name, row
        self.dtype, self.limit, self.largest = dtype, limit, _largest(dtype)
        self.seed, self.steps = 0, 0
        self.size: tuple[int, ...] | None = None  # of the pictures

    @property
    def place(self) -> str:
        """Where the env is: its name, the row, the seed of the episode and the step."""
        return f"the env {self.name} (row {self.row}, seed {self.seed}, step {self.steps})"

    @contextmanager
    def placed(self) -> Iterator[None]:
        """Add the place to a `ForeignError`."""
        try:
            yield
        except ForeignError as error:
            raise ForeignError(f"{self.place}: {error}") from error.__cause__

    def reset(self, seed: int) -> tuple[Any, Mapping[str, Any]]:
        """Begin an episode; return its first observation, and info.

        Args:
            seed: of the episode.

        Raises:
            ForeignError: for an exception of the env, and for what is not two values.
        """
        self.seed, self.steps = seed, 0
        try:
            answer = self.env.reset(seed=seed)
        except (Exception, SystemExit) as error:
            self._fail("reset", error)
        with self.placed():
            if not isinstance(answer, (tuple, list)) or len(answer) != 2:
                raise ForeignError(
                    f"reset returned {_counted(answer)}, not the two of Gymnasium (observation, "
                    "info)"
                )
            observation, info = answer
            if not isinstance(info, Mapping):
                raise ForeignError(f"info of reset is {shown(info)}, not a dictionary")
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Mapping[str, Any]]:
        """Take a step; return observation, reward, terminated, truncated and info.

        Args:
            action: of the env's action space.

        Raises:
            ForeignError: for an exception of the env, for what is not five values, and for a
                reward, flag or info that is none.
        """
        self.steps += 1
        try:
            answer = self.env.step(action)
        except (Exception, SystemExit) as error:
            self._fail("step", error)
        try:
            observation, reward, terminated, truncated, info = self._five(answer)
        except ForeignError as error:
            raise ForeignError(f"{self.place}: {error}") from error.__cause__
        if self.limit is not None and not terminated and not truncated:
            truncated = self._is_too_long(self.limit)
        return observation, reward, terminated, truncated, info

    def _five(self, answer: Any) -> tuple[Any, float, bool, bool, Mapping[str, Any]]:
        """Return the checked values of a step."""
        if not isinstance(answer, (tuple, list)) or len(answer) != 5:
            raise ForeignError(
                f"step returned {_counted(answer)}, not the five of Gymnasium (observation, "
                "reward, terminated, truncated, info)"
            )
        observation, reward, terminated, truncated, info = answer
        # The usual types need no closer look, which would take as long as a step of a small env.
        if (
            isinstance(reward, float)
            and type(terminated) is type(truncated) is bool
            and type(info) is dict
            and -self.largest <= reward <= self.largest
        ):
            return observation, float(reward), terminated, truncated, info
        if not isinstance(info, Mapping):
            raise ForeignError(f"info of step is {shown(info)}, not a dictionary")
        return (
            observation,
            number(reward, "the reward", self.dtype),
            flag(terminated, "terminated"),
            flag(truncated, "truncated"),
            info,
        )

    def read(
        self, observation: Any, entries: Sequence[Callable[[Any], NDArray[Any]]]
    ) -> list[NDArray[Any]]:
        """Return copies of the entries of an observation.

        Args:
            observation: as the env returned it.
            entries: each returns one entry of an observation.

        Raises:
            ForeignError: for an entry that is missing or does not fit its space.
        """
        try:  # without `placed`, which costs as much as a step of a small env
            return [entry(observation) for entry in entries]
        except ForeignError as error:
            raise ForeignError(f"{self.place}: {error}") from error.__cause__

    def _fail(self, call: str, error: BaseException) -> None:
        with foreign(self.place, call):
            raise error

    def _is_too_long(self, limit: int) -> bool:
        """Return whether an episode has reached the limit, and say so."""
        if self.steps < limit:
            return False
        warn_of_limit(self.name, limit, "TimeLimit", SET_LIMIT)
        return True

    def render(self) -> NDArray[np.uint8]:
        """Return a copy of a picture, [height, width] or [height, width, 3 or 4].

        Raises:
            ForeignError: for an exception of the env, and for what is no picture, or one of another
                size than before.
        """
        with foreign(f"the env {self.name}", "render"):
            picture = self.env.render()
        found = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.size > 0
        if not found or not (
            picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] in (3, 4))
        ):
            raise ForeignError(
                f"render returned {shown(picture)}, not a picture [height, width, 3] of uint8"
            )
        if self.size not in (None, picture.shape):
            raise ForeignError(
                f"render returned a picture of the shape {list(picture.shape)} after one of "
                f"{list(self.size or ())}"
            )
        self.size = picture.shape
        return picture.copy()

    def close(self) -> None:
        """Close the env; what it raises is a warning, because nothing depends on it any more."""
        try:
            self.env.close()
        except Exception as error:
            warnings.warn(
                f"the env {self.name} cannot be closed ({type(error).__name__}: "
                f"{shortened(str(error))})",
                stacklevel=2,
            )


def _counted(answer: Any) -> str:
    """Return how many values there are, or what else an env has returned."""
    if isinstance(answer, (tuple, list)):
        return f"{len(answer)} values"
    return shown(answer)


class Predictor:
    """A trained model of another library as a controller: what has `predict` gets `act`.

    The models of Stable-Baselines3 and its relatives have `predict(observation, state,
    episode_start, deterministic)`, which returns the action and the state for the next call.

    Args:
        model: the model. `predict` must take `deterministic`; the others are given if it takes
            them. A space of its own, `observation_space`, decides how it is given choices.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        parameters = inspect.signature(model.predict).parameters
        self.takes = {name for name in ("state", "episode_start") if name in parameters}
        self.reset()

    def reset(self) -> None:
        """Begin an episode: forget the state."""
        self.state, self.first = None, True

    def act(self, observation: Any) -> Any:
        """Return the deterministic action for an observation.

        Args:
            observation: of one row.
        """
        given = {"state": self.state, "episode_start": np.array([self.first])}
        known = {name: given[name] for name in self.takes}
        answer = self.model.predict(observation, deterministic=True, **known)
        self.first = False
        if isinstance(answer, tuple) and len(answer) == 2:
            answer, self.state = answer
        return answer


def predicts(thing: Any) -> bool:
    """Return whether an object or class is a trained model: no `act`, but a `predict`.

    It takes `deterministic`, as those of Stable-Baselines3 do; those of scikit-learn do not.
    """
    predict = getattr(thing, "predict", None)
    if not callable(predict) or callable(getattr(thing, "act", None)):
        return False
    try:
        return "deterministic" in inspect.signature(predict).parameters
    except (TypeError, ValueError):  # some functions written in C have no signature
        return False


def acting(thing: Any) -> Any:
    """Return an object with `act` for one row: a copy of a controller, or a model as a controller.

    Args:
        thing: has `act`, or is a model, which all rows share.
    """
    return Predictor(thing) if predicts(thing) else copy.deepcopy(thing)
