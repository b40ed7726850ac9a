"""One controller that all rows share: a function or a network as a guide.

It must answer for each row alone, and not remember. A controller with a memory, or one that mixes
its rows, gives actions without an error, but wrong ones. Both show where it is asked the same
again.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from coil_rl.foreign.faults import ForeignError, action_array, foreign, shown
from coil_rl.foreign.guard import Guard
from coil_rl.transforms.action_space import ActionSpace, OwnChoices, nested_key
from coil_rl.transforms.hosted import HostedGuide

# Share of the largest number of the actions by which they may differ: for the same question, and in
# a batch of another size, in which a network adds up in another order.
SAME, BESIDE_OTHERS = 1e-5, 1e-2
# Factor and offset of a row, and of two others that must not be mixed with it: one of its size, and
# one beyond all limits of a sum or a maximum.
ROWS = ((1.0, 0.0), (0.37, 1.61), (-1000.0, 1000.0))
COMPARED = 2  # of these; the numbers of the last one are too large to show a small difference
ROUNDING = 1e-4  # of the largest number of an action


class SharedError(ForeignError):
    """A controller cannot be shared by all rows."""


def check_shared(
    title: str, ask: Callable[[Sequence[Tensor]], Tensor], rows: Sequence[Tensor]
) -> None:
    """Ask a controller that all rows share for some rows: each alone, together, and alone again.

    Args:
        title: name of the controller, for messages.
        ask: returns its actions for entries.
        rows: what it reads, [n, ...] each.

    Raises:
        SharedError: if it remembers or draws something, or mixes the rows.
    """
    count = len(rows[0])

    def alone(row: int) -> Tensor:
        return _numbers(ask([entry[row : row + 1].clone() for entry in rows]))

    before, actions = list(map(alone, range(count))), ask([entry.clone() for entry in rows])
    # In another order, as a mean over so many calls is the same in the same one.
    after = list(map(alone, reversed(range(count))))[::-1]
    for row, (one, other) in enumerate(zip(before, after, strict=True)):
        if not _near(one, other, SAME, before):
            raise SharedError(
                f"the controller {title} returned {shown(one)} and then {shown(other)} for the "
                "same observation: all rows share it, so it must not remember or draw anything; "
                "write a class with act(observation) and reset()"
            )
        if actions.shape[:1] != rows[0].shape[:1] or row >= COMPARED:
            continue  # other shapes are refused as actions
        beside = _numbers(actions[row])
        if not _near(one, beside, BESIDE_OTHERS if actions.is_floating_point() else 0.0, before):
            raise SharedError(
                f"the controller {title} returned {shown(one)} for an observation alone, but "
                f"{shown(beside)} for it in a batch of {count}: it mixes the rows, as by a mean "
                "over the batch; write a class with act(observation), which gets one row"
            )


def _numbers(action: Tensor) -> Tensor:
    """Return the numbers of an action, [n]."""
    return torch.atleast_1d(action.detach()).double().flatten()


def _near(one: Tensor, other: Tensor, tolerance: float, actions: Sequence[Tensor]) -> bool:
    """Return whether two answers differ by rounding only; true for what is refused as no number."""
    if one.shape != other.shape:
        return False
    numbers = torch.cat([one, other, *actions[:COMPARED]])
    if not numbers.isfinite().all():
        return True
    return bool(((one - other).abs() <= tolerance * numbers.abs().max()).all())


class _Shared(HostedGuide):
    """Base of guides of one controller for all rows."""

    title: str
    guard: Guard
    space: ActionSpace | None = None  # unknown outside of an env
    choices: OwnChoices = {}  # noqa: RUF012  replaced, never changed
    asked = False  # whether it was checked that it can be shared

    def meet(self, space: ActionSpace, choices: OwnChoices) -> None:
        """Take the space of the actions, which decides what has the form of actions."""
        self.space, self.choices = space, choices

    def unfit(
        self, action: Tensor, batch: torch.Size, space: ActionSpace, problem: str
    ) -> Exception | None:
        """Return the error for an action that does not fit the env."""
        return ForeignError(f"the controller {self.title}: its action {problem}")

    def _actions(
        self, ask: Callable[[Sequence[Tensor]], Tensor], entries: Sequence[Tensor], dims: int
    ) -> Tensor:
        """Return the actions for entries; before the first ones it is checked, see `check_shared`.

        Args:
            ask: returns the actions of the controller for entries.
            entries: [*batch, ...].
            dims: number of dimensions of the batch.
        """
        if torch.compiler.is_compiling():  # a traced function cannot raise
            return ask(entries)
        with self.guard:
            if not self.asked:
                rows = [entry.flatten(0, dims - 1) if dims else entry[None] for entry in entries]
                self._check(ask, rows)
                self.asked = True
            return ask(entries)

    def _check(self, ask: Callable[[Sequence[Tensor]], Tensor], rows: Sequence[Tensor]) -> None:
        """Check it with the first row and others like it, or with rows where it refuses those."""
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of numbers that no env has
            try:
                check_shared(self.title, ask, [_beside_others(entry[0]) for entry in rows])
            except SharedError:
                raise
            except Exception:
                check_shared(self.title, ask, [entry[: len(ROWS)] for entry in rows])

    def _write(self, tensordict: TensorDictBase, action: Tensor) -> TensorDictBase:
        """Write the action, which may be one number for each row, as regressors predict it."""
        if self.space is not None:
            action = self.space.as_column(action, tensordict.batch_size)
        return tensordict.set("action", action)


class NetworkGuide(_Shared, TensorDictModule):
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
        TensorDictModule.__init__(self, network, in_keys=list(in_keys), out_keys=["action"])
        self.title, self.guard = title, Guard()

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
        return self._write(tensordict, self._actions(ask, entries, tensordict.batch_dims))


class FunctionGuide(_Shared):
    """A function as a guide, of one observation or of a batch of them.

    It gets the observations of all rows at once, or of one row after the other.

    A function for a batch gets tensors [B, N] and returns actions [B, A]. One for a single
    observation gets NumPy arrays [N] and returns an action [A], a number or an index. Choices are
    in the numbering of the env, as a Gymnasium env gives them. Which of the two it is, is found out
    at its first call: it is for a batch if it gives the same for a row beside quite other ones as
    for the row alone, in the form of actions, or if it cannot take a row alone. A function that
    remembers something would mix the rows: `check_shared` finds it.

    Args:
        function: takes one value for each of `in_keys`; it must give the same action for the same
            observation.
        in_keys: entries to read, [*batch, ...].
        title: name of the function for messages; by default its own.

    Raises:
        ForeignError: at a call, for what the function raises, for a batch if it can take neither,
            for what it returns that is no action, and for another action for the same observation.
    """

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
        self.guard = Guard()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        if self.for_batch is None:
            with self.guard:
                self.for_batch = self._takes_batch(self._rows(tensordict))
        if self.for_batch:  # traced for an export, so that nothing here may depend on the rows
            entries = [tensordict[key] for key in self.in_keys]
            action = self._actions(self._of_batch, entries, tensordict.batch_dims)
            return self._write(tensordict, action)
        action = self._actions(self._of_rows, self._rows(tensordict), 1).to(tensordict.device)
        return self._write(tensordict, action.reshape(*tensordict.batch_size, *action.shape[1:]))

    def unfit(
        self, action: Tensor, batch: torch.Size, space: ActionSpace, problem: str
    ) -> Exception | None:
        """Return the error for an action that does not fit the env."""
        if self.for_batch:
            return super().unfit(action, batch, space, problem)
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
            alone: the action of each row alone, [n, A].
        """
        if together.shape == alone.shape:
            return True
        return self.space is not None and self.space.takes(together, alone.shape[:1])


def _beside_others(entry: Tensor) -> Tensor:
    """Return an entry of a row, and of two quite other rows, [3, ...]."""
    rows = [factor * entry.double() + offset for factor, offset in ROWS]
    return torch.stack(rows).to(entry.dtype)
