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
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from coil_rl.foreign.faults import ForeignError, action_array, foreign, shown
from coil_rl.foreign.guard import Guard
from coil_rl.transforms.action_space import ActionSpace, OwnForms, nested_key
from coil_rl.transforms.hosted import HostedGuide

# Share of the largest number of the actions by which they may differ: for the same question; in a
# batch of another size, in which a network adds up in another order; and of NumPy and torch.
SAME, BESIDE_OTHERS, ROUNDING = 1e-5, 1e-2, 1e-4
# Factor and offset of a row, and of two others that must not be mixed with it: one of its size, and
# one beyond all limits of a sum or a maximum.
ROWS = ((1.0, 0.0), (0.37, 1.61), (-1000.0, 1000.0))
COMPARED = 2  # of these; the numbers of the last one are too large to show a small difference

Ask = Callable[[Sequence[Tensor]], Tensor]  # entries [n, ...] to actions [n, A]


class SharedError(ForeignError):
    """A controller cannot be shared by all rows."""


def takes_batch(
    title: str, rows: Sequence[Tensor], together: Ask, each: Ask | None, form: Callable[..., bool]
) -> bool:
    """Return whether a controller takes all rows at once; false: one after the other.

    It is asked for the first row and others like it, or for the rows where it refuses those.

    Args:
        title: name of the controller, for messages.
        rows: what it reads, [n, ...] each.
        together: asks it for all rows at once.
        each: asks it for one row after the other; None if it cannot be.
        form: returns whether an answer for all rows has the form of actions, beside those alone.

    Raises:
        SharedError: if it remembers or draws something, or mixes the rows.
    """
    if each is not None:
        try:
            each([entry[:1] for entry in rows])
        except Exception:
            each = None
    try:
        return _agrees(title, [_beside_others(entry[0]) for entry in rows], together, each, form)
    except SharedError:
        raise
    except Exception:
        first = [entry[: len(ROWS)] for entry in rows]
        return _agrees(title, first, each or together, None, form) and each is None


def _agrees(
    title: str, rows: Sequence[Tensor], together: Ask, each: Ask | None, form: Callable[..., bool]
) -> bool:
    """Ask for rows alone, together in two orders and as a batch of one, and alone again.

    See `takes_batch`.
    """
    count, single = len(rows[0]), each or together

    def alone(row: int) -> Tensor:
        return _numbers(single([entry[row : row + 1].clone() for entry in rows]))

    before, batches = list(map(alone, range(count))), []
    # An array of NumPy takes a tensor of one number as its index, and gives no batch of one then.
    orders = list(range(count)), list(reversed(range(count))), [0]
    try:
        batches = [together([entry[order].clone() for entry in rows]) for order in orders]
    except Exception:
        if each is None:
            raise
    # In another order, as a mean over so many calls is the same in the same one.
    after = list(map(alone, orders[1]))[::-1]
    for one, other in zip(before, after, strict=True):
        if not _near(one, other, SAME, before):
            raise SharedError(
                f"the controller {title} returned {shown(one)} and then {shown(other)} for the "
                "same observation: all rows share it, so it must not remember or draw anything; "
                "write a class with act(observation) and reset()"
            )
    for batch, order in zip(batches, orders, strict=True):
        row = _other_row(batch, order, before, ROUNDING if each else BESIDE_OTHERS)
        if each is not None and (row is not None or not form(batch, before[0], len(order))):
            return False
        if row is not None:
            beside = shown(_numbers(batch[order.index(row)]))
            raise SharedError(
                f"the controller {title} returned {shown(before[row])} for an observation alone, "
                f"but {beside} for it in a batch of {count}: it mixes the rows, as by a mean over "
                "the batch; write a class with act(observation), which gets one row"
            )
    return bool(batches)


def _other_row(
    batch: Tensor, order: list[int], alone: Sequence[Tensor], tolerance: float
) -> int | None:
    """Return the first row whose actions differ in a batch and alone; None if there is none.

    Others than one for each row are refused as actions.
    """
    if batch.shape[:1] != (len(order),):
        return None
    if not batch.is_floating_point():
        tolerance = 0.0
    for row in range(min(COMPARED, len(order))):
        if not _near(alone[row], _numbers(batch[order.index(row)]), tolerance, alone):
            return row
    return None


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


class SharedGuide(HostedGuide):
    """A network or a function as a guide, one for all rows.

    A network gets the entries of all rows, [B, N], and returns actions [B, A]. A function gets the
    observations of all rows at once, or of one row after the other.

    A function for a batch gets tensors [B, N] and returns actions [B, A]. One for a single
    observation gets NumPy arrays [N] and returns an action [A], a number or an index. Whole
    numbers and choices are as a Gymnasium env gives them. Which of the two it is, is found out
    at its first call: it is for a batch if it gives the same for a row beside quite other ones as
    for the row alone, in the form of actions, or if it cannot take a row alone. A function that
    remembers something would mix the rows: `takes_batch` finds it.

    Args:
        module: the network, or the function of one value for each of `in_keys`; it must give the
            same action for the same observation.
        in_keys: entries to read, [*batch, ...].
        title: its name, for messages.

    Raises:
        ForeignError: at a call, for what a function raises for one row, for a batch if it can take
            neither, for what it returns that is no action, for another action for the same
            observation, and for a network whose action depends on the other rows.
    """

    space: ActionSpace | None = None  # unknown outside of an env
    own: OwnForms = {}  # noqa: RUF012  replaced, never changed
    for_batch: bool | None = None  # unknown before the first call

    def __init__(
        self, module: Callable[..., Any], in_keys: Sequence[NestedKey], title: str
    ) -> None:
        self.in_keys: list[NestedKey] = [nested_key(key) for key in in_keys]
        self.out_keys = ["action"]
        super().__init__()
        self.module, self.title, self.guard = module, title, Guard()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, which may be one number for each row, as regressors predict it."""
        entries = [tensordict[key] for key in self.in_keys]
        if torch.compiler.is_compiling():  # a traced function cannot raise
            action = self._of_batch(entries)
        else:
            action = self._actions(entries, tensordict.batch_dims)
        if self.space is not None:
            action = self.space.as_column(action, tensordict.batch_size)
        return tensordict.set("action", action)

    def _of_batch(self, entries: Sequence[Tensor]) -> Tensor:
        """Return the actions for all rows."""
        if isinstance(self.module, nn.Module):
            action = self.module(*entries)
        else:
            action = self.module(*(entry.clone() for entry in self._as_given(entries)))
        if isinstance(action, Tensor):
            return action  # checked on its device by `GuideActions`
        return torch.as_tensor(action_array(action), device=entries[0].device)

    def _by_row(self, entries: Sequence[Tensor]) -> Tensor:
        """Return the actions of a function for one row after the other."""
        rows = [self._alone(entries, row) for row in range(len(entries[0]))]
        if len({row.shape for row in rows}) > 1:
            shapes = ", ".join(sorted({str(list(row.shape)) for row in rows}))
            raise ForeignError(
                f"the controller {self.title} returned actions of the shapes {shapes} in one step"
            )
        return torch.from_numpy(np.stack(rows))

    def _alone(self, entries: Sequence[Tensor], row: int) -> NDArray[Any]:
        """Return the action for one row, as an array of at least one dimension."""
        with foreign(f"the controller {self.title} (row {row})", "it"):
            alone = self._as_given([entry[row] for entry in entries])
            return action_array(self.module(*(each.cpu().numpy().copy()[()] for each in alone)))

    def _as_given(self, entries: Sequence[Tensor]) -> list[Tensor]:
        """Return entries as the env gives them, [*batch, ...]."""
        named = zip(self.in_keys, entries, strict=True)
        return [self.own[key](entry) if key in self.own else entry for key, entry in named]

    def meet(self, space: ActionSpace, own: OwnForms) -> None:
        """Take the space of the actions, which decides what has the form of actions."""
        self.space, self.own = space, own

    def unfit(
        self, action: Tensor, batch: torch.Size, space: ActionSpace, problem: str
    ) -> Exception | None:
        """Return the error for an action that does not fit the env."""
        if self.for_batch:
            return ForeignError(f"the controller {self.title}: its action {problem}")
        number, returned, problem = space.unfit_row(action, batch)
        place = f"the controller {self.title} (row {number})"
        return ForeignError(f"{place}: it returned {shown(returned)}, which {problem}")

    def _actions(self, entries: Sequence[Tensor], dims: int) -> Tensor:
        """Return the actions for entries; before the first ones it is tried, see `takes_batch`.

        Args:
            entries: [*batch, ...].
            dims: number of dimensions of the batch.
        """
        with self.guard:
            rows = [entry.flatten(0, dims - 1) if dims else entry[None] for entry in entries]
            if self.for_batch is None:
                each = None if isinstance(self.module, nn.Module) else self._by_row
                with torch.no_grad(), warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of numbers that no env has
                    self.for_batch = takes_batch(
                        self.title, rows, self._of_batch, each, self._has_form
                    )
            if self.for_batch:
                return self._of_batch(entries)
            action = self._by_row(rows).to(rows[0].device)
            return action.reshape(*entries[0].shape[:dims], *action.shape[1:])

    def _has_form(self, together: Tensor, alone: Tensor, count: int) -> bool:
        """Return whether an answer for a batch has the form of actions.

        Args:
            alone: the numbers of the first row alone.
            count: of rows in the batch.
        """
        if together.numel() != count * alone.numel() or not together.isfinite().all():
            return False
        if together.shape == (count, *alone.shape):
            return True
        return self.space is not None and self.space.takes(together, torch.Size([count]))


def _beside_others(entry: Tensor) -> Tensor:
    """Return an entry of a row, and of two quite other rows, [3, ...]."""
    rows = [factor * entry.double() + offset for factor, offset in ROWS]
    return torch.stack(rows).to(entry.dtype)
