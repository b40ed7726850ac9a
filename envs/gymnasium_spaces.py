"""Gymnasium's spaces as specs and entries of TorchRL.

A guide or policy of this project reads tensors of numbers. So a choice becomes a one-hot vector,
and nested Dict and Tuple spaces become nested keys.
"""

from collections.abc import Iterator, Sequence
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

MOST_CHOICES = 32  # of a whole number that is an action


class Entry:
    """One entry of the observation: where it is found, its spec, and its conversion to numbers.

    Args:
        id: of the env, for the `ValueError` about a space that is not supported.
        path: keys of Dict spaces and indices of Tuple spaces.
        space: of the entry.
        floats: dtype of entries that are not uint8.
    """

    def __init__(
        self, id: str, path: tuple[str | int, ...], space: spaces.Space[Any], floats: np.dtype[Any]
    ) -> None:
        self.path, self.dtype, self.start = path, floats, start(space)
        # Not the entry of a Dict space: the observation itself, or within a Tuple.
        whole = not path or isinstance(path[0], int)
        names = [str(part) for part in path]
        self.key: tuple[str, ...] = ("observation", *names) if whole else tuple(names)
        self.choices = _choices(space)
        dtype = torch.from_numpy(np.empty(0, floats)).dtype
        if self.choices:
            self.spec: TensorSpec = MultiOneHot(self.choices, dtype=dtype)
            # Places of the first choices in the vector.
            self.first = np.cumsum([0, *self.choices[:-1]])
        elif isinstance(space, spaces.Box) and space.dtype == np.uint8:
            self.dtype = np.dtype(np.uint8)
            self.spec = Unbounded(space.shape or (1,), dtype=torch.uint8)
        elif isinstance(space, spaces.Box):
            self.spec = Unbounded(space.shape or (1,), dtype=dtype)
        elif isinstance(space, spaces.MultiBinary):
            self.spec = Bounded(0, 1, space.shape, dtype=dtype)
        else:
            raise ValueError(
                f"the observation of {id} has a {type(space).__name__} space: replace it with a "
                "wrapper"
            )

    def __call__(self, observations: Sequence[Any]) -> NDArray[Any]:
        """Return this entry of observations, [B, *shape]."""
        for part in self.path:
            observations = [observation[part] for observation in observations]
        count = len(observations)
        if not self.choices:
            return np.array(observations, dtype=self.dtype).reshape(count, *self.spec.shape)
        chosen = (np.array(observations) - self.start).reshape(count, -1) + self.first
        vectors = np.zeros((count, *self.spec.shape), self.dtype)
        np.put_along_axis(vectors, chosen, 1, 1)
        return vectors


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


def action_spec(id: str, space: spaces.Space[Any], dtype: torch.dtype) -> TensorSpec:
    """Return the spec of an action of one env.

    Args:
        id: of the env, for the `ValueError` about a space that is not supported.
        space: of the action.
        dtype: of actions that are real numbers.
    """
    if has_whole_numbers(space):
        return _whole_numbers(id, space)
    if isinstance(space, spaces.Box):
        shape = space.shape or (1,)
        if not (np.isfinite(space.low).any() or np.isfinite(space.high).any()):
            return Unbounded(shape, dtype=dtype)
        low, high = (
            torch.as_tensor(bound, dtype=dtype).reshape(shape) for bound in (space.low, space.high)
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
