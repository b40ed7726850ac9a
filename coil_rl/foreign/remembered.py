"""Objects that remember something: one copy for each row, and what a checkpoint holds of them."""

import copy
import io
import pickle
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

OF_TORCH = frozenset(vars(nn.Module()))
# What numbers of NumPy are made of. They keep their types, as float32 goes on in another way.
OF_NUMPY: list[Any] = [np.dtype, np.float64(0).__reduce__()[0]]
OF_NUMPY += {type(np.dtype(each)) for each in "?bhilqBHILQefdg"}


def maker_of_rows(thing: Any) -> partial[Any]:
    """Return a function that makes a copy of an object with `act`, for one row of the env.

    Copies of a network share its weights, and are in evaluation mode.
    """
    if not isinstance(thing, nn.Module):
        return partial(copy.deepcopy, thing)
    return partial(_copy_of_network, thing.eval())


def _copy_of_network(network: nn.Module) -> nn.Module:
    with torch.no_grad():
        return copy.deepcopy(network, {id(each): each for each in network.parameters()})


def state_of(thing: Any, make: Callable[[], Any]) -> dict[str, Any] | None:
    """Return what `state_dict` of an object says; None if the object remembers more.

    A network whose class leaves `state_dict` to torch may remember something in plain attributes,
    or in buffers that are not persistent: what is another than in a new object.
    """
    if isinstance(thing, nn.Module) and type(thing).state_dict is nn.Module.state_dict:
        with torch.random.fork_rng():
            new = dict(_plain(make()))
        now = dict(_plain(thing))
        if now.keys() != new.keys() or not all(_is_same(now[place], new[place]) for place in now):
            return None
    state: dict[str, Any] = thing.state_dict()
    return state


def _plain(network: nn.Module) -> Iterator[tuple[tuple[str, str], Any]]:
    """Yield what torch does not save of a network: by part and name, the value."""
    for part, module in network.named_modules():
        for name, value in vars(module).items():
            if name not in OF_TORCH:
                yield (part, name), value
        for name in module._non_persistent_buffers_set:
            yield (part, name), module._buffers[name]


def copied(value: Any) -> Any:
    """Return a value as a checkpoint gives it back; what it cannot hold is an `UnpicklingError`."""
    file = io.BytesIO()
    torch.save(value, file)
    file.seek(0)
    return loaded(file)


def loaded(file: io.BytesIO, device: str | None = None) -> Any:
    """Return what `torch.save` wrote, without running code from the file.

    These are the plain values of torch, and numbers of NumPy.
    """
    with torch.serialization.safe_globals(OF_NUMPY):
        return torch.load(file, map_location=device, weights_only=True)


def _is_same(value: Any, other: Any) -> bool:
    """Return whether two values are one, or have the same content."""
    if isinstance(value, torch.Tensor):  # of which a pickle has the place in memory
        return isinstance(other, torch.Tensor) and torch.equal(value, other)
    return value is other or pickled(value) == pickled(other) != b""


def pickled(value: Any) -> bytes:
    """Return the content of a value; empty for what cannot be pickled."""
    try:
        return pickle.dumps(value)
    except Exception:  # whatever the pickling of somebody else's object raises
        return b""
