"""Objects that remember something: one copy for each row, and what a checkpoint holds of them."""

import copy
import io
import pickle
import weakref
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import nn

from coil_rl.foreign.faults import FaultError, shortened

OF_TORCH = frozenset(vars(nn.Module()))
# What numbers of NumPy are made of. They keep their types, as float32 goes on in another way.
OF_NUMPY: list[Any] = [np.dtype, np.float64(0).__reduce__()[0]]
OF_NUMPY += {type(np.dtype(each)) for each in "?bhilqBHILQefdg"}


def own(value: Any) -> Any:
    """Return a value whose dictionaries and lists are new, as code of others may change them."""
    if type(value) is dict:
        return {key: own(each) for key, each in value.items()}
    if type(value) is partial:
        return Anew(value)
    return [own(each) for each in value] if type(value) is list else value


class Anew(partial[Any]):
    """A `functools.partial` whose calls share no dictionary and no list of its arguments."""

    def __call__(self, *args: Any, **arguments: Any) -> Any:
        """Call the function with new dictionaries and lists in place of those given before."""
        return self.func(*own([*self.args]), *args, **own(self.keywords) | arguments)


def maker_of_rows(thing: Any) -> partial[Any]:
    """Return a function that makes a copy of an object with `act`, for one row of the env.

    Copies of a network share its weights, and are in evaluation mode. What cannot be copied is a
    `FaultError` where a copy is made.
    """
    return partial(_copy_of, thing.eval() if isinstance(thing, nn.Module) else thing)


def _copy_of(thing: Any) -> Any:
    shared = thing.parameters() if isinstance(thing, nn.Module) else ()
    try:
        with torch.no_grad():
            return copy.deepcopy(thing, {id(each): each for each in shared})
    except Exception as error:
        raise FaultError(
            f"it cannot be copied for each row ({type(error).__name__}: {shortened(str(error))}); "
            "give its class, of which each row gets an object"
        ) from error


def state_of(thing: Any, make: Callable[[], Any]) -> dict[str, Any] | None:
    """Return what `state_dict` of an object says; None if the object remembers more.

    A network whose class leaves `state_dict` to torch may remember something in plain attributes,
    or in buffers that are not persistent: those that differ from a new object's.
    """
    if isinstance(thing, nn.Module) and type(thing).state_dict is nn.Module.state_dict:
        with torch.random.fork_rng():
            new = make()
        if _remembers_more(thing, new):
            return None
    state: dict[str, Any] = thing.state_dict()
    return state


def _remembers_more(network: nn.Module, new: nn.Module) -> bool:
    """Return whether attributes and buffers that torch does not save differ from a new one's."""
    now, begun, names, of_new = _plain(network), _plain(new), _names(network), _names(new)
    return now.keys() != begun.keys() or not all(
        value is begun[place] or pickled(value, names) == pickled(begun[place], of_new) != b""
        for place, value in now.items()
    )


def _plain(network: nn.Module) -> dict[tuple[str, str], Any]:
    """Return the attributes and buffers that torch does not save, by part and name."""
    found = {}
    for part, module in network.named_modules():
        unsaved = {name: module._buffers[name] for name in module._non_persistent_buffers_set}
        for name, value in (vars(module) | unsaved).items():
            if name not in OF_TORCH:
                found[part, name] = value
    return found


def _names(network: nn.Module) -> dict[int, str]:
    """Return the names of the parameters by `id`: torch saves them, wherever else they are held."""
    return {id(value): name for name, value in network.named_parameters()}


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


class _Pickler(pickle.Pickler):
    """Writes numbers where torch and weak references write a place in memory.

    Args:
        names: names that are written in place of parameters, by the `id` of each.
    """

    def __init__(self, file: io.BytesIO, names: Mapping[int, str]) -> None:
        super().__init__(file)
        self.names = names

    def reducer_override(self, value: Any) -> Any:
        if id(value) in self.names:
            return str, (self.names[id(value)],)
        if isinstance(value, torch.Tensor):
            return torch.from_numpy, (value.detach().cpu().numpy(),)
        if isinstance(value, weakref.ref):
            return weakref.ref, (value(),)
        return NotImplemented


def pickled(value: Any, names: Mapping[int, str] | None = None) -> bytes:
    """Return the content of a value as bytes; empty if it cannot be pickled.

    Args:
        names: names that are written in place of parameters, by the `id` of each.
    """
    file = io.BytesIO()
    try:
        _Pickler(file, names or {}).dump(value)
    except Exception:  # whatever the pickling of somebody else's object raises
        return b""
    return file.getvalue()
