"""Check of a controller that all rows share: it must answer for each row alone, and not remember.

A controller with a memory, or one that mixes its rows, gives actions without an error, but wrong
ones. Both show where it is asked the same again.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from coil_rl.foreign.faults import ForeignError, shown

# Of the largest number of the actions: for the same question, and in a batch of another size, in
# which a network adds up in another order, on some devices with few digits.
SAME, BESIDE_OTHERS = 1e-5, 1e-2


class SharedCheck:
    """Asks a controller that all rows share again, in its calls 1, 2, 4, 8 and so on.

    Before and after the rows of such a call it is asked for one row of the last such call, and must
    give the same action. Where it takes a batch, it must give the first row of the call the same
    action alone. So the check costs two or three answers for one row, in ever fewer calls.

    Args:
        title: name of the controller, for messages.
    """

    def __init__(self, title: str) -> None:
        self.title, self.calls = title, 0
        self.earlier: list[Tensor] = []  # one row of an earlier call

    def __call__(
        self, ask: Callable[[Sequence[Tensor]], Tensor], entries: Sequence[Tensor], dims: int
    ) -> Tensor:
        """Return the actions for the entries.

        Args:
            ask: returns the actions of the controller for entries.
            entries: what it reads, [*batch, ...] each.
            dims: number of dimensions of the batch.

        Raises:
            ForeignError: if the controller remembers or draws something, or mixes the rows.
        """
        if torch.compiler.is_compiling():  # a traced function cannot raise
            return ask(entries)
        self.calls += 1
        if self.calls & (self.calls - 1):  # no power of two
            return ask(entries)
        first = [entry[(slice(0, 1),) * dims].clone() for entry in entries]
        earlier = self.earlier if _alike(self.earlier, first) else first
        before = _numbers(ask(earlier))
        actions = ask(entries)
        self._check_repeated(before, _numbers(ask(earlier)), _numbers(actions))
        if entries[0].shape[:dims].numel() > 1:
            self._check_alone(lambda: _numbers(ask(first)), actions, entries[0].shape[:dims])
        self.earlier = first
        return actions

    def _check_repeated(self, before: Tensor, after: Tensor, actions: Tensor) -> None:
        """Refuse two answers for one observation.

        Args:
            before: the first answer.
            after: the second one.
            actions: other ones, for their size.
        """
        if before.shape == after.shape and _near(before, after, SAME, actions):
            return
        raise ForeignError(
            f"the controller {self.title} returned {shown(before)} and then {shown(after)} for "
            "the same observation: all rows share it, so it must not remember or draw anything; "
            "write a class with act(observation) and reset()"
        )

    def _check_alone(
        self, ask_alone: Callable[[], Tensor], actions: Tensor, batch: torch.Size
    ) -> None:
        """Refuse an answer for the first row alone that is another one than in the batch.

        Args:
            ask_alone: returns the answer for the first row.
            actions: those for all rows.
            batch: of the rows.
        """
        if actions.shape[: len(batch)] != batch:  # refused as an action
            return
        alone, beside = ask_alone(), _numbers(actions.reshape(batch.numel(), -1)[0])
        tolerance = BESIDE_OTHERS if actions.is_floating_point() else 0.0
        if alone.shape == beside.shape and _near(alone, beside, tolerance, _numbers(actions)):
            return
        self._check_repeated(alone, ask_alone(), beside)
        raise ForeignError(
            f"the controller {self.title} returned {shown(alone)} for an observation alone, but "
            f"{shown(beside)} for it in a batch of {batch.numel()}: it mixes the rows, as by a "
            "mean over the batch; write a class with act(observation), which gets one row"
        )


def _numbers(action: Tensor) -> Tensor:
    """Return the numbers of an action, [n]."""
    return torch.atleast_1d(action.detach()).double().flatten()


def _near(one: Tensor, other: Tensor, tolerance: float, actions: Tensor) -> bool:
    """Return whether two answers differ by rounding only; true for what is refused as no number.

    Args:
        one: numbers.
        other: as many numbers.
        tolerance: of the largest number.
        actions: further numbers, for their size.
    """
    numbers = torch.cat([one, other, actions])
    if not numbers.isfinite().all():
        return True
    return bool(((one - other).abs() <= tolerance * numbers.abs().max()).all())


def _alike(earlier: Sequence[Tensor], first: Sequence[Tensor]) -> bool:
    """Return whether two rows have entries of the same shapes, dtypes and devices."""
    return len(earlier) == len(first) and all(
        (one.shape, one.dtype, one.device) == (other.shape, other.dtype, other.device)
        for one, other in zip(earlier, first, strict=True)
    )
