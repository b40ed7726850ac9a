"""Gymnasium's spaces as specs and entries of TorchRL.

A guide or policy of this project reads tensors of numbers. So a choice becomes a one-hot vector,
and nested Dict and Tuple spaces become nested keys.
"""

import math
import warnings
from collections.abc import Iterator, Mapping
from typing import Any, TypeGuard

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    MultiOneHot,
    TensorSpec,
    Unbounded,
)

from coil_rl.foreign.faults import ForeignError, plain_array, shown

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


class Choices:
    """Conversion of one-hot vectors side by side to the choices of a space, in its numbering.

    Args:
        space: a Discrete or MultiDiscrete space.
    """

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.sizes, self.shape = _choices(space), tuple(space.shape or ())
        self.first = torch.as_tensor(np.ravel(start(space)).astype(np.int64))

    def __call__(self, vectors: torch.Tensor) -> torch.Tensor:
        """Return the choices, [*batch, *shape] with the shape of the space, as whole numbers.

        Args:
            vectors: [*batch, n].
        """
        parts = vectors.split(self.sizes, -1)
        indices = torch.stack([part.argmax(-1) for part in parts], -1)
        own = indices + self.first.to(indices.device)
        return own.reshape((*vectors.shape[:-1], *self.shape))


class Entry:
    """One entry of the observation: where it is found, its spec, and its conversion to numbers.

    Args:
        id: of the env, for the `ValueError` about a space that is not supported.
        path: keys of Dict spaces and indices of Tuple spaces.
        space: of the entry.
        floats: dtype of entries that are no pixels.
    """

    def __init__(
        self, id: str, path: tuple[str | int, ...], space: spaces.Space[Any], floats: np.dtype[Any]
    ) -> None:
        self.path, self.dtype, self.start = path, floats, start(space)
        self.space, self.shape = space, tuple(space.shape or ())
        self.binary = isinstance(space, spaces.MultiBinary)
        # Not the entry of a Dict space: the observation itself, or within a Tuple.
        whole = not path or isinstance(path[0], int)
        names = [str(part) for part in path]
        self.key: tuple[str, ...] = ("observation", *names) if whole else tuple(names)
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
        self.id, self.fineness = id, Fineness(f"the env {id}", self.title, self.dtype)

    def __call__(self, observation: Any) -> NDArray[Any]:
        """Return a copy of this entry of an observation, of the shape of `spec`.

        Args:
            observation: of one env, as it was returned.

        Raises:
            ForeignError: for an entry that is missing, of another shape than its space has, not of
                numbers, not finite, or no choice of its space.
        """
        for part in self.path:
            observation = self._part(observation, part)
        value = plain_array(observation, self.title)
        if value.shape != self.shape and not self._is_single(value):
            raise ForeignError(
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
            raise ForeignError(f"{self.title} holds {wrong}, not a finite number of {self.dtype}")
        return converted

    @property
    def bounds(self) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Declared bounds, of the shape and dtype of `spec`; None for pixels and choices.

        They are not those of `spec`, as some published envs leave them.
        """
        if not isinstance(self.space, spaces.Box) or not self.spec.dtype.is_floating_point:
            return None
        low, high = (
            torch.from_numpy(bound.astype(self.dtype).reshape(self.given))
            for bound in (self.space.low, self.space.high)
        )
        return low, high

    def outside(self, values: NDArray[Any]) -> tuple[int, float, float, float] | None:
        """Return where numbers are farthest outside the bounds of the space; None if nowhere.

        Bounds are rounded as the numbers were.

        Args:
            values: of this entry, [n, *shape].

        Returns:
            The index of the number in the entry, its value, and its bounds.
        """
        if not isinstance(self.space, spaces.Box):
            return None
        bounds = (self.space.low, self.space.high)
        low, high = (bound.ravel().astype(self.dtype).astype(np.float64) for bound in bounds)
        numbers = values.reshape(len(values), -1).astype(np.float64)
        excess = np.maximum(low - numbers, numbers - high)
        if not excess.size or excess.max() <= 0:
            return None
        row, index = np.unravel_index(excess.argmax(), excess.shape)
        return int(index), float(numbers[row, index]), float(low[index]), float(high[index])

    def _is_single(self, value: NDArray[Any]) -> bool:
        """Return whether a value is one number, which may have a dimension of its own."""
        return value.size == 1 and value.ndim <= 1 and self.shape in ((), (1,))

    def _part(self, observation: Any, part: str | int) -> Any:
        """Return a part of an observation by the key of a Dict space or the index of a Tuple."""
        if isinstance(part, int):
            if not isinstance(observation, (tuple, list)) or len(observation) <= part:
                raise ForeignError(
                    f"{self.title} is missing: the observation is {shown(observation)}, not the "
                    "tuple of its space"
                )
        elif not isinstance(observation, Mapping) or part not in observation:
            keys = list(observation) if isinstance(observation, Mapping) else observation
            raise ForeignError(
                f"{self.title} is missing: the observation has {shown(keys)}, but its space has "
                f"the key {part!r}"
            )
        return observation[part]

    def _check(self, value: NDArray[Any], fits: NDArray[np.bool_] | np.bool_) -> None:
        """Raise a `ForeignError` if a number does not fit the space."""
        if not np.all(fits):
            wrong = float(value[np.logical_not(fits)].reshape(-1)[0])
            raise ForeignError(f"{self.title} holds {wrong:g}, which is not in {self.space}")

    def _one_hot(self, value: NDArray[Any]) -> NDArray[Any]:
        """Return choices as one-hot vectors side by side."""
        chosen = np.ravel(value) - np.ravel(self.start)
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


def leaves(
    space: spaces.Space[Any], path: tuple[str | int, ...] = ()
) -> Iterator[tuple[Any, spaces.Space[Any]]]:
    """Yield the path and the space of all entries but texts.

    Args:
        space: of the observation, or of a part of it.
        path: of that part: keys of Dict spaces and indices of Tuple spaces.
    """
    if isinstance(space, spaces.Dict):
        for name, part in space.spaces.items():
            yield from leaves(part, (*path, name))
    elif isinstance(space, spaces.Tuple):
        for index, part in enumerate(space.spaces):
            yield from leaves(part, (*path, index))
    elif space.dtype is None or space.dtype.kind != "U":
        yield path, space


def _is_picture(space: spaces.Space[Any]) -> bool:
    """Return whether a space is of pixels, which networks divide by 255."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return False
    return len(space.shape) == 3 or bool((space.high == 255).all())


def _choices(space: spaces.Space[Any]) -> list[int]:
    """Return the numbers of choices of a Discrete or MultiDiscrete space; none for another."""
    sizes = space.n if isinstance(space, spaces.Discrete) else getattr(space, "nvec", [])
    return [int(size) for size in np.ravel(sizes)]


def start(space: spaces.Space[Any]) -> Any:
    """Return the lowest value of a Discrete or MultiDiscrete space; 0 for another."""
    return getattr(space, "start", 0)


def lowest_choices(space: spaces.Space[Any]) -> Any:
    """Return the lowest number of each choice of an action; 0 for real numbers."""
    if has_whole_numbers(space):
        return space.low.astype(np.int64)
    return start(space)


def has_whole_numbers(space: spaces.Space[Any]) -> TypeGuard[spaces.Box]:
    """Return whether a space is a Box of whole numbers, each of which is a choice as an action."""
    return isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.integer)


def _whole_numbers(id: str, space: spaces.Box) -> TensorSpec:
    """Return the spec of an action of whole numbers: a few are choices, more a `ValueError`."""
    sizes = space.high.astype(np.float64) - space.low.astype(np.float64) + 1
    if len(space.shape) != 1 or sizes.max() > MOST_CHOICES:
        raise ValueError(
            f"the action of {id} is a {space} of whole numbers, which are choices, but only up to "
            f"{MOST_CHOICES} of each and in one dimension: replace it with a wrapper"
        )
    return MultiCategorical([int(size) for size in sizes], dtype=torch.int64)


def _fine_enough(space: spaces.Box, dtype: torch.dtype) -> torch.dtype:
    """Return the dtype of an action: float64 where its range has too few steps of the given one.

    Args:
        space: of the action; one that is as coarse itself needs no finer dtype.
        dtype: of other actions.
    """
    if space.dtype.kind != "f" or space.dtype.itemsize <= dtype.itemsize:
        return dtype
    # From a single bound on, actions count in units of 1.
    low, high = (
        np.where(np.isfinite(bound), bound, other + side)
        for bound, other, side in ((space.low, space.high, -1), (space.high, space.low, 1))
    )
    floats = torch.empty(0, dtype=dtype).numpy().dtype
    with np.errstate(all="ignore"):  # of coordinates without bounds, and of very large ones
        count = (high - low) / np.spacing(np.maximum(abs(low), abs(high)).astype(floats))
    return torch.float64 if (count < COARSE).any() else dtype


def action_spec(id: str, space: spaces.Space[Any], dtype: torch.dtype) -> TensorSpec:
    """Return the spec of an action of one env; a matrix of real numbers is a vector.

    Args:
        id: of the env, for the `ValueError` about a space that is not supported.
        space: of the action.
        dtype: of actions that are real numbers, unless it is too coarse for their range.
    """
    if has_whole_numbers(space):
        return _whole_numbers(id, space)
    if isinstance(space, spaces.Box):
        shape = (math.prod(space.shape),)
        if not (np.isfinite(space.low).any() or np.isfinite(space.high).any()):
            return Unbounded(shape, dtype=dtype)
        dtype = _fine_enough(space, dtype)
        low, high = (
            torch.as_tensor(bound, dtype=dtype).reshape(shape) for bound in (space.low, space.high)
        )
        for index in (low >= high).nonzero().flatten().tolist()[:1]:
            raise ValueError(
                f"number {index} of the action of {id} has the bounds {space.low.flat[index]} and "
                f"{space.high.flat[index]}, which are equal in {dtype}: subtract the offset in a "
                "wrapper"
            )
        return Bounded(low, high, shape, dtype=dtype)
    if isinstance(space, spaces.Discrete):
        return Categorical(int(space.n), dtype=torch.int64)
    if isinstance(space, spaces.MultiDiscrete) and len(space.shape) == 1:
        return MultiCategorical(_choices(space), dtype=torch.int64)
    if isinstance(space, spaces.MultiBinary):
        return Binary(shape=space.shape, dtype=torch.int8)
    raise ValueError(
        f"the action of {id} is a {type(space).__name__} space: replace it with a wrapper"
    )


def check_action_space(id: str, space: Any) -> None:
    """Check that an action space leaves something to choose.

    Args:
        id: of the env, for the message.
        space: of the action.

    Raises:
        ValueError: for what is no space of Gymnasium, for one without a number, and for bounds that
            are NaN, equal or in the wrong order.
    """
    if not isinstance(space, spaces.Space):
        raise ValueError(
            f"the action_space of {id} is {shown(space)}, not a space of Gymnasium: set it in its "
            "__init__"
        )
    if not isinstance(space, spaces.Box):
        return
    if 0 in space.shape:
        raise ValueError(f"the action of {id} has the shape {list(space.shape)}: it has no number")
    low, high = np.ravel(space.low), np.ravel(space.high)
    wrong = np.flatnonzero(~(low < high))
    if len(wrong):
        index = int(wrong[0])
        raise ValueError(
            f"number {index} of the action of {id} has the bounds {low[index]} and {high[index]}: "
            "the lower one must be smaller; leave a number without a choice out by a wrapper"
        )
