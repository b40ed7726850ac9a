"""A plain function as a guide, of one observation or of a batch of them."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from coil_rl.foreign.faults import ForeignError, action_array, foreign, shown
from coil_rl.foreign.shared import SharedCheck
from coil_rl.transforms.action_space import ActionSpace, OwnChoices, nested_key

# Factor and offset of a row, and of two others that a function for a batch must not mix with it:
# one of its size, and one beyond all limits of a sum or a maximum.
ROWS = ((1.0, 0.0), (0.37, 1.61), (-1000.0, 1000.0))
ROUNDING = 1e-4  # of the largest number of an action


class FunctionGuide(TensorDictModuleBase):
    """A function as a guide, of one observation or of a batch of them.

    It gets the observations of all rows at once, or of one row after the other.

    A function for a batch gets tensors [B, N] and returns actions [B, A]. One for a single
    observation gets NumPy arrays [N] and returns an action [A], a number or an index. Choices are
    in the numbering of the env, as a Gymnasium env gives them. Which of the two it is, is found out
    at its first call: it is for a batch if it gives the same for a row beside quite other ones as
    for the row alone, in the form of actions, or if it cannot take a row alone. A function that
    remembers something would mix the rows: `SharedCheck` finds it.

    Args:
        function: takes one value for each of `in_keys`; it must give the same action for the same
            observation.
        in_keys: entries to read, [*batch, ...].
        title: name of the function for messages; by default its own.

    Raises:
        ForeignError: at a call, for what the function raises, for a batch if it can take neither,
            for what it returns that is no action, and for another action for the same observation.
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
        self.space: ActionSpace | None = None  # unknown outside of an env
        self.choices: OwnChoices = {}
        self.shared = SharedCheck(self.title)

    def in_space(self, space: ActionSpace) -> None:
        """Take the space of the actions of an env, which decides what has the form of actions."""
        self.space = space

    def reads_choices(self, choices: OwnChoices) -> None:
        """Read choices as the env gives them from here on, not as one-hot vectors.

        Args:
            choices: what converts an entry, by entry.
        """
        self.choices = choices

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        if self.for_batch is None:
            self.for_batch = self._takes_batch(self._rows(tensordict))
        if self.for_batch:  # traced for an export, so that nothing here may depend on the rows
            entries = [tensordict[key] for key in self.in_keys]
            return tensordict.set(
                "action", self.shared(self._of_batch, entries, tensordict.batch_dims)
            )
        action = self.shared(self._of_rows, self._rows(tensordict), 1).to(tensordict.device)
        return tensordict.set("action", action.reshape(*tensordict.batch_size, *action.shape[1:]))

    def unfit(
        self, action: Tensor, batch: torch.Size, space: ActionSpace, problem: str
    ) -> ForeignError:
        """Return the error for an action that does not fit the env, see `unfit_action`."""
        if self.for_batch:
            return ForeignError(f"the controller {self.title}: its action {problem}")
        number, returned, problem = space.unfit_row(action, batch)
        place = f"the controller {self.title} (row {number})"
        return ForeignError(f"{place}: it returned {shown(returned)}, which {problem}")

    def _rows(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Return the entries that the function gets, with one dimension of rows."""
        flat = tensordict.select(*self.in_keys).reshape(-1)
        return [flat[key] for key in self.in_keys]

    def _as_given(self, entries: Sequence[Tensor]) -> list[Tensor]:
        """Return entries as the env gives them, [*batch, ...]."""
        named = zip(self.in_keys, entries, strict=True)
        return [self.choices[key](entry) if key in self.choices else entry for key, entry in named]

    def _of_batch(self, entries: Sequence[Tensor]) -> Tensor:
        """Return the actions for all rows."""
        with foreign(f"the controller {self.title}", "it"):
            action = self.function(*(entry.clone() for entry in self._as_given(entries)))
        if isinstance(action, Tensor):
            return action  # checked on its device by `GuideActions`
        try:
            return torch.as_tensor(action_array(action), device=entries[0].device)
        except ForeignError as error:
            raise ForeignError(f"the controller {self.title}: {error}") from error

    def _of_rows(self, entries: Sequence[Tensor]) -> Tensor:
        """Return the actions for one row after the other."""
        rows = [self._alone(entries, row) for row in range(len(entries[0]))]
        if len({row.shape for row in rows}) > 1:
            shapes = ", ".join(sorted({str(list(row.shape)) for row in rows}))
            raise ForeignError(
                f"the controller {self.title} returned actions of the shapes {shapes} in one step"
            )
        return torch.as_tensor(np.stack(rows))

    def _alone(self, entries: Sequence[Tensor], row: int) -> NDArray[Any]:
        """Return the action for one row, as an array of at least one dimension."""
        with foreign(f"the controller {self.title} (row {row})", "it"):
            alone = self._as_given([entry[row] for entry in entries])
            action = self.function(*(entry.cpu().numpy().copy()[()] for entry in alone))
        try:
            return action_array(action)
        except ForeignError as error:
            raise ForeignError(f"the controller {self.title} (row {row}): {error}") from error

    def _takes_batch(self, entries: Sequence[Tensor]) -> bool:
        """Return whether the function takes a batch, see the class."""
        try:
            self._alone(entries, 0)
        except Exception:
            return True
        rows = [_beside_others(entry[0]) for entry in entries]
        try:
            each = [torch.as_tensor(self._alone(rows, row)) for row in range(len(rows[0]))]
            alone = torch.stack(each).double()
            return all(self._agrees(rows, alone, order) for order in ([0, 1, 2], [2, 1, 0]))
        except Exception:
            return False

    def _agrees(self, rows: Sequence[Tensor], alone: Tensor, order: list[int]) -> bool:
        """Return whether the function gives rows together what it gives each of them alone.

        Args:
            rows: entries of the rows, [n, ...].
            alone: the action of each row alone, [n, A].
            order: of the rows.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of NumPy, which gets tensors here
            entries = self._as_given([entry[order] for entry in rows])
            together = torch.as_tensor(self.function(*entries))
        if together.numel() != alone.numel() or not self._has_form(together, alone):
            return False
        difference = (together.cpu().reshape(alone.shape) - alone[order]).abs()
        # NumPy and torch may add up in another order.
        return bool((difference <= ROUNDING * alone[order].abs().amax(-1, keepdim=True)).all())

    def _has_form(self, together: Tensor, alone: Tensor) -> bool:
        """Return whether an answer for a batch has the form of actions.

        Args:
            together: the answer.
            alone: the action of each row alone, [n, A].
        """
        if together.shape == alone.shape:
            return True
        return self.space is not None and self.space.takes(together, alone.shape[:1])


def _beside_others(entry: Tensor) -> Tensor:
    """Return an entry of a row, and of two quite other rows, [3, ...]."""
    rows = [factor * entry.double() + offset for factor, offset in ROWS]
    return torch.stack(rows).to(entry.dtype)
