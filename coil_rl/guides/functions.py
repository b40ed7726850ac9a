"""A plain function as a guide, of one observation or of a batch of them."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.envs.gate import ForeignError, action_array, foreign
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
        title: name of the function for messages; by default its own.

    Raises:
        ForeignError: at a call, for what the function raises, for a batch if it can take neither,
            and for what it returns that is no action.
    """

    foreign = True

    def __init__(
        self,
        function: Callable[..., Any],
        in_keys: Sequence[NestedKey] = ("observation",),
        title: str = "",
    ) -> None:
        self.in_keys: list[NestedKey] = [nested_key(key) for key in in_keys]
        self.out_keys = ["action"]
        super().__init__()
        self.function = function
        self.title = title or getattr(function, "__name__", type(function).__name__)
        self.for_batch: bool | None = None  # unknown before the first call

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        if self.for_batch is None:
            first = tensordict.select(*self.in_keys).reshape(-1)
            self.for_batch = self._takes_batch([first[key] for key in self.in_keys])
        if self.for_batch:
            action = self._of_batch([tensordict[key] for key in self.in_keys])
            return tensordict.set("action", action)
        flat = tensordict.select(*self.in_keys).reshape(-1)
        entries = [flat[key] for key in self.in_keys]
        rows = [self._alone(entries, row) for row in range(len(flat))]
        if len({row.shape for row in rows}) > 1:
            shapes = ", ".join(sorted({str(list(row.shape)) for row in rows}))
            raise ForeignError(
                f"the controller {self.title} returned actions of the shapes {shapes} in one step"
            )
        action = torch.as_tensor(np.stack(rows), device=tensordict.device)
        return tensordict.set("action", action.reshape(*tensordict.batch_size, *action.shape[1:]))

    def _of_batch(self, entries: Sequence[Tensor]) -> Tensor:
        """Return the actions for all rows."""
        with foreign(f"the controller {self.title}", "it"):
            action = self.function(*(entry.clone() for entry in entries))
        if isinstance(action, Tensor):
            return action  # checked on its device by `GuideActions`
        try:
            return torch.as_tensor(action_array(action), device=entries[0].device)
        except ForeignError as error:
            raise ForeignError(f"the controller {self.title}: {error}") from error

    def _alone(self, entries: Sequence[Tensor], row: int) -> NDArray[Any]:
        """Return the action for one row, as an array of at least one dimension."""
        with foreign(f"the controller {self.title} (row {row})", "it"):
            action = self.function(*(entry[row].cpu().numpy().copy() for entry in entries))
        try:
            return action_array(action)
        except ForeignError as error:
            raise ForeignError(f"the controller {self.title} (row {row}): {error}") from error

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
