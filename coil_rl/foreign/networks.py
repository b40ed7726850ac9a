"""Networks as guides: those that are asked by `forward`, and those that have an `act`."""

import copy
import inspect
import io
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from coil_rl.foreign.shared import SharedCheck

# Key of a saved state with the attributes of a network and its parts that torch does not save.
PLAIN = "plain attributes"
OF_TORCH = frozenset(vars(nn.Module()))
SAVED = (type(None), bool, int, float, str, Tensor)  # a checkpoint can hold them


class NetworkGuide(TensorDictModule):
    """A network as a guide: entries [B, N] to actions [B, A].

    Args:
        network: the network.
        in_keys: entries to read.
        title: name of the network, for messages.

    Raises:
        ForeignError: at a call, for a network that gives another action for the same observation,
            or one that depends on the other rows.
    """

    def __init__(self, network: nn.Module, in_keys: Sequence[NestedKey], title: str) -> None:
        super().__init__(network, in_keys=list(in_keys), out_keys=["action"])
        self.shared = SharedCheck(title)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        forward = super().forward

        def ask(entries: Sequence[Tensor]) -> Tensor:
            data = TensorDict({}, [], device=tensordict.device)
            for key, entry in zip(self.in_keys, entries, strict=True):
                data.set(key, entry)
            action: Tensor = forward(data)["action"]
            return action

        entries = [tensordict[key] for key in self.in_keys]
        return tensordict.set("action", self.shared(ask, entries, tensordict.batch_dims))


def acts(thing: Any) -> bool:
    """Return whether a class or an object has a method `act`.

    Of a network its class must define it: an attribute `act` is often its activation function.

    Args:
        thing: the class or object.
    """
    kind = thing if inspect.isclass(thing) else type(thing)
    if not issubclass(kind, nn.Module):
        return callable(getattr(thing, "act", None))
    own = inspect.getattr_static(kind, "act", None)
    return inspect.isfunction(own) or isinstance(own, (staticmethod, classmethod))


def maker_of_rows(thing: Any) -> partial[Any]:
    """Return a function that makes a copy of an object with `act`, for one row of the env.

    Copies of a network share its weights, and are in evaluation mode.

    Args:
        thing: the object.
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

    Args:
        thing: the object.
        make: makes a new one.
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
    """Give an object with `load_state_dict` what `state_of` returned.

    Args:
        thing: a new object.
        state: of one of its class.
    """
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


def _can_be_saved(value: Any) -> bool:
    """Return whether a value can be saved, and loaded again without running code from the file."""
    if type(value) in SAVED:
        return True
    file = io.BytesIO()
    try:
        torch.save(value, file)
        file.seek(0)
        torch.load(file, weights_only=True)
    except (pickle.PickleError, TypeError, AttributeError, RuntimeError):
        return False
    return True


def _is_same(value: Any, other: Any) -> bool:
    """Return whether two values are one, or have the same content."""
    try:
        return value is other or pickle.dumps(value) == pickle.dumps(other)
    except (pickle.PickleError, TypeError, AttributeError, RuntimeError):
        return False
