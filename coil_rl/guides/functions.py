"""A plain function as a guide, of one observation or of a batch of them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.transforms.action_space import nested_key


class FunctionGuide(TensorDictModuleBase):
    """A function as a guide, of one observation or of a batch of them.

    It gets the observations of all rows at once, or of one row after the other.

    A function for a batch gets tensors [B, N] and returns actions [B, A]. One for a single
    observation gets NumPy arrays [N] and returns an action [A], a number or an index. Which of the
    two it is, is found out at its first call: it is for a batch if it gives the same for a row in a
    batch as for the row alone, or if it cannot take a row alone.

    Args:
        function: takes one value for each of `in_keys`; it must give the same action for the same
            observation.
        in_keys: entries to read, [*batch, ...].

    Raises:
        Exception: at a call, what the function raises for a batch, if it can take neither.
    """

    def __init__(
        self, function: Callable[..., Any], in_keys: Sequence[NestedKey] = ("observation",)
    ) -> None:
        self.in_keys: list[NestedKey] = [nested_key(key) for key in in_keys]
        self.out_keys = ["action"]
        super().__init__()
        self.function = function
        self.for_batch: bool | None = None  # unknown before the first call

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        flat = tensordict.select(*self.in_keys).reshape(-1)
        entries = [flat[key] for key in self.in_keys]
        if self.for_batch is None:
            self.for_batch = self._takes_batch(entries)
        if self.for_batch:
            whole = [tensordict[key] for key in self.in_keys]
            return tensordict.set("action", self.function(*whole))
        rows = [self._alone(entries, row) for row in range(len(flat))]
        action = torch.as_tensor(np.stack(rows), device=tensordict.device)
        return tensordict.set("action", action.reshape(*tensordict.batch_size, *action.shape[1:]))

    def _alone(self, entries: Sequence[Tensor], row: int) -> Any:
        """Return the action for one row, as an array of at least one dimension."""
        return np.atleast_1d(self.function(*(entry[row].cpu().numpy().copy() for entry in entries)))

    def _takes_batch(self, entries: Sequence[Tensor]) -> bool:
        """Return whether the function takes a batch, see the class."""
        try:
            alone = torch.as_tensor(self._alone(entries, 0))
        except Exception:
            return True
        try:
            twice = [torch.stack([entry[0], entry[0]]) for entry in entries]
            both = torch.as_tensor(self.function(*twice)).cpu()
            pair = torch.stack([alone, alone]).to(both.dtype)
            return both.numel() == pair.numel() and torch.allclose(both.reshape(pair.shape), pair)
        except Exception:
            return False
