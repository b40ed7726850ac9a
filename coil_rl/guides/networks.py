"""Networks as guides: those that are asked by `forward`, and those that have an `act`."""

import copy
import inspect
from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from coil_rl.guides.shared import SharedCheck


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
