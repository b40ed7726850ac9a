"""A space of Gymnasium as entries, specs and actions of TorchRL, and back.

A guide or policy of this project reads tensors of numbers. So a choice becomes a one-hot vector,
and nested Dict and Tuple spaces become nested keys.
"""

import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import NestedKey, unravel_key
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    TensorSpec,
    Unbounded,
)

from coil_rl.foreign.faults import FaultError, ForeignError, plain_array, shown
from coil_rl.foreign.makers import Env
from coil_rl.transforms.action_space import OwnForms, choices_of

MOST_CHOICES = 32  # of a whole number that is an action
WATCHED = 256  # first observations, in which the range of each number is found
# A number whose range has fewer steps of its dtype than COARSE is rounded too much to act on; fewer
# than STILL are the rounding of the env itself.
COARSE, STILL = 100.0, 1e-6
FEW = 16  # numbers


class Fineness:
    """Warns if the first values of some numbers need more digits than their dtype has.

    Args:
        place: where they come from, for the warning.
        title: of the numbers, for the warning.
        dtype: to which they are rounded.

    Attributes:
        unseen: how many values are still to be seen.
    """

    def __init__(self, place: str, title: str, dtype: np.dtype[Any]) -> None:
        self.place, self.title, self.dtype = place, title, dtype
        self.unseen = WATCHED if dtype.kind == "f" else 0

    def see(self, value: NDArray[Any]) -> None:
        """Take a value; after the last one, warn if its range has too few steps of the dtype."""
        if self.unseen == WATCHED:
            self.low = self.high = value.astype(np.float64)
        self.low, self.high = np.minimum(self.low, value), np.maximum(self.high, value)
        self.unseen -= 1
        if self.unseen:
            return
        with np.errstate(all="ignore"):  # of numbers that are refused anyway
            step = np.spacing(np.maximum(abs(self.low), abs(self.high)).astype(self.dtype))
            count = ((self.high - self.low) / step).ravel()
        for index in np.flatnonzero((count > STILL) & (count < COARSE))[:1]:
            low, high = self.low.flat[index], self.high.flat[index]
            which = f"number {index} of {self.title}" if self.low.ndim else self.title
            warnings.warn(
                f"{self.place}: {which} goes from {low} to {high}, but {self.dtype} has steps of "
                f"{step.flat[index]:.2g} there, so little of it is seen: subtract its offset in a "
                "wrapper",
                stacklevel=2,
            )


class Entry:
    """One entry of the observation: where it is found, its spec, and its conversion, and back.

    Networks get floats, one-hot vectors for choices, and [1] for a number of the shape ().

    Args:
        id: of the env, for the `ValueError` about a space that is not supported.
        path: keys of Dict spaces and indices of Tuple spaces.
        space: of the entry.
        floats: dtype of entries that are no pixels.
    """

    def __init__(
        self, id: str, path: tuple[str | int, ...], space: spaces.Space[Any], floats: np.dtype[Any]
    ) -> None:
        self.path, self.dtype, self.start = path, floats, np.ravel(_start(space))
        self.lowest = torch.as_tensor(self.start.astype(np.int64))
        self.space, self.shape = space, tuple(space.shape or ())
        self.binary = isinstance(space, spaces.MultiBinary)
        # Not the entry of a Dict space: the observation itself, or within a Tuple.
        whole = not path or isinstance(path[0], int)
        names = [str(part) for part in path]
        key = ("observation", *names) if whole else tuple(names)
        self.name, self.key = key[0], unravel_key(key)
        self.title = ".".join(["the observation", *names])
        self.choices = _choices(space)
        dtype = torch.from_numpy(np.empty(0, floats)).dtype
        if self.choices:
            self.spec: TensorSpec = MultiOneHot(self.choices, dtype=dtype)
            # Places of the first choices in the vector.
            self.first = np.cumsum([0, *self.choices[:-1]])
        elif _is_picture(space):
            self.dtype = np.dtype(np.uint8)
            self.spec = Unbounded(space.shape or (1,), dtype=torch.uint8)
        elif isinstance(space, spaces.Box):
            self.spec = Unbounded(space.shape or (1,), dtype=dtype)
        elif isinstance(space, spaces.MultiBinary):
            self.spec = Binary(shape=torch.Size(space.shape), dtype=dtype)
        else:
            raise ValueError(
                f"the observation of {id} has a {type(space).__name__} space: replace it with a "
                "wrapper"
            )
        self.given = tuple(self.spec.shape)
        self.whole = _is_whole(space) and self.spec.dtype == dtype
        self.id, self.fineness = id, Fineness(f"the env {id}", self.title, self.dtype)

    def __call__(self, observation: Any) -> NDArray[Any]:
        """Return a copy of this entry of an observation, of the shape of `spec`.

        Args:
            observation: of one env, as it was returned.

        Raises:
            FaultError: for an entry that is missing, of another shape than its space has, not of
                numbers, not finite, or no choice of its space.
        """
        for part in self.path:
            observation = self._part(observation, part)
        value = plain_array(observation, self.title)
        # One number may have a dimension of its own.
        if value.shape != self.shape and not (
            value.size == 1 and value.ndim <= 1 and self.shape in ((), (1,))
        ):
            raise FaultError(
                f"{self.title} has the shape {list(value.shape)}, but its space has "
                f"{list(self.shape)}"
            )
        if self.choices:
            return self._one_hot(value)
        if self.dtype == np.uint8 and value.dtype != np.uint8:
            self._check(value, (value >= 0) & (value <= 255) & (value == np.floor(value)))
        if self.binary:
            self._check(value, (value == 0) | (value == 1))
        if value.dtype == self.dtype:
            converted = value.copy()
            if converted.shape != self.given:
                converted = converted.reshape(self.given)
        else:
            if self.fineness.unseen and not np.can_cast(value.dtype, self.dtype, "safe"):
                self.fineness.see(value)
            with np.errstate(over="ignore"):
                converted = value.astype(self.dtype).reshape(self.given)
        if converted.dtype.kind == "f" and not _are_finite(converted):
            wrong = float(value.reshape(-1)[~np.isfinite(converted.reshape(-1))][0])
            raise FaultError(f"{self.title} holds {wrong}, not a finite number of {self.dtype}")
        return converted

    def own(self, entry: torch.Tensor) -> torch.Tensor:
        """Return numbers as the env has them, [*batch, *shape] with the shape of the space.

        Args:
            entry: [*batch, n] for choices, else [*batch, *shape], with a dimension more for a
                single number.
        """
        if not self.choices:
            batch = entry.shape[: entry.ndim - max(1, len(self.shape))]
            return (entry.long() if self.whole else entry).reshape((*batch, *self.shape))
        parts = entry.split(self.choices, -1)
        indices = torch.stack([part.argmax(-1) for part in parts], -1)
        own = indices + self.lowest.to(indices.device)
        return own.reshape((*entry.shape[:-1], *self.shape))

    @property
    def bounds(self) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """Declared bounds, of the shape and dtype of `spec`; None for choices.

        They are not those of `spec`, as some published envs leave them.
        """
        if not isinstance(self.space, spaces.Box):
            return None
        sides = self.space.low, self.space.high
        low, high = (side.astype(self.dtype).reshape(self.given) for side in sides)
        return low, high

    def _part(self, observation: Any, part: str | int) -> Any:
        """Return a part of an observation by the key of a Dict space or the index of a Tuple."""
        if isinstance(part, int):
            if not isinstance(observation, (tuple, list)) or len(observation) <= part:
                raise FaultError(
                    f"{self.title} is missing: the observation is {shown(observation)}, not the "
                    "tuple of its space"
                )
        elif not isinstance(observation, Mapping) or part not in observation:
            keys = list(observation) if isinstance(observation, Mapping) else observation
            raise FaultError(
                f"{self.title} is missing: the observation has {shown(keys)}, but its space has "
                f"the key {part!r}"
            )
        return observation[part]

    def _check(self, value: NDArray[Any], fits: NDArray[np.bool_] | np.bool_) -> None:
        """Raise a `FaultError` if a number does not fit the space."""
        if not np.all(fits):
            wrong = float(value[np.logical_not(fits)].reshape(-1)[0])
            raise FaultError(f"{self.title} holds {wrong:g}, which is not in {self.space}")

    def _one_hot(self, value: NDArray[Any]) -> NDArray[Any]:
        """Return choices as one-hot vectors side by side."""
        chosen = np.ravel(value) - self.start
        sizes = np.array(self.choices)
        fits = (chosen >= 0) & (chosen < sizes) & (chosen == np.floor(chosen))
        self._check(value.reshape(-1), fits)
        vector = np.zeros(self.given, self.dtype)
        vector[chosen.astype(np.int64) + self.first] = 1
        return vector


def _are_finite(numbers: NDArray[Any]) -> bool:
    """Return whether all numbers are finite."""
    if numbers.size <= FEW:  # one by one takes a quarter of the time
        return all(map(math.isfinite, numbers.ravel().tolist()))
    return bool(np.isfinite(numbers).all())


def _leaves(
    space: spaces.Space[Any], path: tuple[str | int, ...] = ()
) -> Iterator[tuple[Any, spaces.Space[Any]]]:
    """Yield the path and the space of all entries but texts.

    Args:
        space: of the observation, or of a part of it.
        path: of that part: keys of Dict spaces and indices of Tuple spaces.
    """
    if isinstance(space, spaces.Dict):
        for name, part in space.spaces.items():
            yield from _leaves(part, (*path, name))
    elif isinstance(space, spaces.Tuple):
        for index, part in enumerate(space.spaces):
            yield from _leaves(part, (*path, index))
    elif space.dtype is None or space.dtype.kind != "U":
        yield path, space


def _is_picture(space: spaces.Space[Any]) -> bool:
    """Return whether a space is of pixels, which networks divide by 255."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return False
    return len(space.shape) == 3 or bool((space.high == 255).all())


def _is_whole(space: spaces.Space[Any]) -> bool:
    """Return whether the numbers of a space are whole."""
    return np.dtype(space.dtype).kind in "iub"


def _choices(space: spaces.Space[Any]) -> list[int]:
    """Return the numbers of choices of a Discrete or MultiDiscrete space; none for another."""
    sizes = space.n if isinstance(space, spaces.Discrete) else getattr(space, "nvec", [])
    return [int(size) for size in np.ravel(sizes)]


def _start(space: spaces.Space[Any]) -> Any:
    """Return the lowest value of a Discrete or MultiDiscrete space; 0 for another."""
    return getattr(space, "start", 0)


class Actions:
    """The actions of an env as numbers of TorchRL, and back.

    Args:
        name: of the env, for messages.
        space: of the action.
        dtype: of actions that are real numbers.

    Attributes:
        spec: of an action of one env; a matrix of real numbers is a vector.
        first: lowest number of each choice, if not 0.
        own_shape: shape of an action as controllers give it, where it is a matrix.

    Raises:
        ValueError: for a space that is not supported, or leaves nothing to choose: for what is no
            space of Gymnasium, for one without a number, and for bounds that are NaN, equal or in
            the wrong order.
    """

    def __init__(self, name: str, space: Any, dtype: torch.dtype) -> None:
        self.name, self.space, self.dtype = name, space, dtype
        is_box = isinstance(space, spaces.Box)
        self.whole = is_box and np.issubdtype(space.dtype, np.integer)
        self.real = is_box and not self.whole
        self.spec = self._spec()
        self.own_shape = space.shape if self.real and len(space.shape) > 1 else None
        self.lowest = space.low.astype(np.int64) if self.whole else _start(space)
        lowest = torch.as_tensor(self.lowest).reshape(-1)
        self.first = lowest if lowest.any() else None

    def _check_box(self) -> None:
        space = self.space
        if 0 in space.shape:
            raise ValueError(
                f"the action of {self.name} has the shape {list(space.shape)}: it has no number"
            )
        low, high = np.ravel(space.low), np.ravel(space.high)
        for index in np.flatnonzero(~(low < high))[:1]:
            raise ValueError(
                f"number {index} of the action of {self.name} has the bounds {low[index]} and "
                f"{high[index]}: the lower one must be smaller; leave a number without a choice "
                "out by a wrapper"
            )

    def _spec(self) -> TensorSpec:
        space = self.space
        if isinstance(space, spaces.Box):
            self._check_box()
            return self._of_whole_numbers() if self.whole else self._of_real_numbers()
        if isinstance(space, spaces.Discrete):
            return Categorical(int(space.n), dtype=torch.int64)
        if isinstance(space, spaces.MultiDiscrete) and len(space.shape) == 1:
            return MultiCategorical(_choices(space), dtype=torch.int64)
        if isinstance(space, spaces.MultiBinary):
            return Binary(shape=space.shape, dtype=torch.int8)
        raise ValueError(
            f"the action of {self.name} is a {type(space).__name__} space: replace it with a "
            "wrapper that has a Box, a Discrete or a MultiDiscrete"
        )

    def _of_whole_numbers(self) -> TensorSpec:
        """Return the spec of whole numbers: a few are choices, more a `ValueError`."""
        space = self.space
        sizes = space.high.astype(np.float64) - space.low.astype(np.float64) + 1
        if len(space.shape) != 1 or sizes.max() > MOST_CHOICES:
            raise ValueError(
                f"the action of {self.name} is a {space} of whole numbers, which are choices, but "
                f"only up to {MOST_CHOICES} of each and in one dimension: replace it with a wrapper"
            )
        return MultiCategorical([int(size) for size in sizes], dtype=torch.int64)

    def _of_real_numbers(self) -> TensorSpec:
        space, shape = self.space, (math.prod(self.space.shape),)
        if not (np.isfinite(space.low).any() or np.isfinite(space.high).any()):
            return Unbounded(shape, dtype=self.dtype)
        bounds = [
            torch.as_tensor(bound, dtype=self.dtype).reshape(shape)
            for bound in (space.low, space.high)
        ]
        low, high = (bound.numpy() for bound in bounds)
        with np.errstate(all="ignore"):  # of coordinates without bounds, and of very large ones
            count = (high - low) / np.spacing(np.maximum(abs(low), abs(high)))
        # A space may itself be as coarse.
        least = COARSE if space.dtype.itemsize > low.itemsize else 0.0
        for index in np.flatnonzero(count <= least)[:1]:
            raise ValueError(
                f"number {index} of the action of {self.name} goes from {space.low.flat[index]} to "
                f"{space.high.flat[index]}, where {self.dtype} has too few steps: subtract the "
                "offset in a wrapper"
            )
        return Bounded(*bounds, shape, dtype=self.dtype)

    def decode(self, actions: NDArray[Any]) -> NDArray[Any]:
        """Return actions as the env takes them, real numbers within its bounds.

        Args:
            actions: [..., *A] with A as in `spec`.

        Raises:
            ForeignError: for a number that is not finite.
        """
        if not self.real:
            numbered: NDArray[Any] = actions + self.lowest
            return numbered.astype(self.space.dtype)
        if not np.isfinite(actions).all():
            raise ForeignError(
                f"the action for the env {self.name} holds a number that is not finite: the policy "
                "or its guide gave none"
            )
        typed = actions.astype(self.space.dtype)
        typed = typed.reshape(*actions.shape[:-1], *self.space.shape)
        return np.clip(typed, self.space.low, self.space.high)

    def fitted(self, action: NDArray[Any], place: str) -> NDArray[Any]:
        """Return the action of a controller in the shape and numbering of the env.

        Args:
            action: what the controller gave, of choices also their one-hot vectors; the bounds of
                real numbers are not checked.

        Raises:
            ForeignError: for what is no action of the env.
        """
        sizes = choices_of(self.spec)
        if action.shape == (sum(sizes),) and np.isin(action, (0, 1)).all():
            parts = np.split(action, np.cumsum(sizes)[:-1])
            if all(part.sum() == 1 for part in parts):
                indices = np.array([part.argmax() for part in parts])
                action = indices.reshape(self.space.shape) + self.lowest
        if action.size == 1 and math.prod(self.space.shape or ()) == 1:
            action = action.reshape(self.space.shape)
        if self.real:
            fits = action.shape == self.space.shape
        else:
            typed = action.astype(self.space.dtype)
            fits = bool((typed == action).all()) and self.space.contains(typed)
        if not fits:
            raise ForeignError(f"{place}: act returned {shown(action)}, no action of {self.space}")
        return np.array(action)


class Codec:
    """The spaces of a Gymnasium env: its observation as entries, and its actions.

    Args:
        name: of the env, for messages.
        env: the env.
        dtype: of entries that are no pixels, of actions and of rewards.

    Attributes:
        entries: of the observation, at least one of which has a number.
        actions: of the env.
        fineness: watch on the rewards of all rows.

    Raises:
        ValueError: for spaces that are not supported.
    """

    def __init__(self, name: str, env: Env, dtype: torch.dtype) -> None:
        self.name, self.env = name, env
        self.floats = torch.empty(0, dtype=dtype).numpy().dtype
        space = env.observation_space
        self.entries = [Entry(name, path, leaf, self.floats) for path, leaf in _leaves(space)]
        if all(0 in entry.given for entry in self.entries):
            raise ValueError(
                f"the observation_space of {name} is {space}, which has no numbers; observe at "
                "least one, such as a constant"
            )
        self.actions = Actions(name, env.action_space, dtype)
        self.fineness = Fineness(f"the env {name}", "the reward", self.floats)
        self.largest = float(np.finfo(self.floats).max)  # number of a reward

    @property
    def own_forms(self) -> OwnForms:
        """What converts entries from the form of networks to that of the env, by key."""
        own = [each for each in self.entries if each.whole or each.given != each.shape]
        return {entry.key: entry.own for entry in own}

    def read(self, observation: Any) -> dict[NestedKey, NDArray[Any]]:
        """Return copies of the entries of an observation, by their keys.

        Args:
            observation: as an env returned it; a `ForeignError` if it does not fit its space.
        """
        return {entry.key: entry(observation) for entry in self.entries}

    def check_same(self, env: Env, row: int) -> None:
        """Raise a `ValueError` for an env whose spaces are others."""
        for which in ("action_space", "observation_space"):
            if env is not self.env and getattr(env, which) != getattr(self.env, which):
                raise ValueError(
                    f"the {which} of {self.name} is {getattr(env, which)} in row {row}, but "
                    f"{getattr(self.env, which)} in row 0: all envs of a run need the same spaces"
                )
