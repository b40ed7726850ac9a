"""Objects that remember something: one copy for each row, and what a checkpoint holds of them."""

import copy
import io
import pickle
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
from torch import nn

# Key of a saved state with the attributes of a network and its parts that torch does not save.
PLAIN = "plain attributes"
OF_TORCH = frozenset(vars(nn.Module()))
UNSAVED = (pickle.PickleError, TypeError, AttributeError, RuntimeError)


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
    """Return all that an object with `state_dict` remembers; None if a checkpoint cannot hold it.

    A network whose class leaves `state_dict` to torch may remember something in plain attributes,
    or in buffers that are not persistent. They are part of its state, but for those that cannot be
    saved and are as in a new object, such as a configuration.
    """
    state: dict[str, Any] = thing.state_dict()
    if not isinstance(thing, nn.Module) or type(thing).state_dict is not nn.Module.state_dict:
        return state
    plain = {place: value for place, value in _plain(thing) if _can_be_saved(value)}
    others = {place: value for place, value in _plain(thing) if place not in plain}
    if others:
        with torch.random.fork_rng():
            new = dict(_plain(make()))
        if not all(place in new and _is_same(value, new[place]) for place, value in others.items()):
            return None
    return {**state, PLAIN: plain}


def restore(thing: Any, state: Mapping[str, Any]) -> None:
    """Give an object with `load_state_dict` what `state_of` returned."""
    saved = dict(state)
    plain = saved.pop(PLAIN, {}) if isinstance(thing, nn.Module) else {}
    thing.load_state_dict(saved)
    for (part, name), value in plain.items():
        setattr(thing.get_submodule(part), name, value)


def _plain(network: nn.Module) -> Iterator[tuple[tuple[str, str], Any]]:
    """Yield what torch does not save of a network: by part and name, the value."""
    for part, module in network.named_modules():
        for name, value in vars(module).items():
            if name not in OF_TORCH:
                yield (part, name), value
        for name in module._non_persistent_buffers_set:
            yield (part, name), module._buffers[name]


def copied(value: Any) -> Any:
    """Return a value as a checkpoint gives it back; what it cannot hold is an `UnpicklingError`.

    It is loaded without running code from the file.
    """
    file = io.BytesIO()
    torch.save(value, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def _can_be_saved(value: Any) -> bool:
    """Return whether a checkpoint can hold a value."""
    try:
        copied(value)
    except UNSAVED:
        return False
    return True


def _is_same(value: Any, other: Any) -> bool:
    """Return whether two values are one, or have the same content."""
    return value is other or pickled(value) == pickled(other) != b""


def pickled(value: Any) -> bytes:
    """Return the content of a value; empty for what cannot be pickled."""
    try:
        return pickle.dumps(value)
    except Exception:  # whatever the pickling of somebody else's object raises
        return b""
