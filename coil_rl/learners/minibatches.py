"""Minibatches: how a batch of rollouts is divided for the steps of the optimiser."""

from collections.abc import Iterator
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from coil_rl.learners.networks import REMEMBERED
from coil_rl.learners.state import Stateful


class Minibatches(Stateful):
    """Random minibatches of single steps.

    Args:
        epochs: passes over a batch, each in another random order.
        count: minibatches in each pass.
        seed: of the random orders.
    """

    parts: ClassVar[tuple[str, ...]] = ("generator",)

    def __init__(self, epochs: int, count: int, seed: int) -> None:
        self.epochs, self.count = epochs, count
        self.generator = torch.Generator().manual_seed(seed)

    def rows(self, batch: TensorDictBase) -> TensorDictBase:
        """Return what minibatches are drawn from: the steps of a batch [B, T], [B * T]."""
        return batch.reshape(-1)

    def draw(self, rows: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yield the minibatches [N] of all passes over `rows`.

        Raises:
            ValueError: if there are too few rows.
        """
        for order in self.orders(rows):
            yield from rows[order].split(self.size(rows))

    def size(self, rows: TensorDictBase) -> int:
        """Return the number of rows of a minibatch."""
        return len(rows) // self.count

    def orders(self, rows: TensorDictBase) -> Iterator[Tensor]:
        """Yield the indices of the rows of each pass, those of its minibatches one after the other.

        Raises:
            ValueError: if there are too few rows.
        """
        size = self.size(rows)
        if size * rows.shape[1:].numel() < 2:  # one advantage cannot be standardised
            raise ValueError(
                f"minibatches={self.count} leaves less than 2 of {rows.numel()} frames to each"
            )
        for _ in range(self.epochs):
            order = torch.randperm(len(rows), generator=self.generator)[: size * self.count]
            yield order.to(rows.device)


class RowMinibatches(Minibatches):
    """Random minibatches of whole rows of a batch, for a policy with a memory.

    The GRU is run again from the stored first state of each row, so that gradients flow through
    time. After that the steps are a minibatch as any other.

    Args:
        epochs: passes over a batch, each in another random order.
        count: minibatches in each pass.
        seed: of the random orders.
        memory: the part of the policy up to its GRU; it writes `remembered`.
    """

    def __init__(self, epochs: int, count: int, seed: int, memory: TensorDictModuleBase) -> None:
        super().__init__(epochs, count, seed)
        self.memory = memory

    def rows(self, batch: TensorDictBase) -> TensorDictBase:
        """Return what minibatches are drawn from: the rows of a batch, [B, T]."""
        return batch.reshape(-1, batch.shape[-1])

    def draw(self, rows: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yield the minibatches [N] of all passes over `rows`.

        Raises:
            ValueError: if there are fewer rows than minibatches, or a minibatch would have less
                than two steps.
        """
        self.check_rows(len(rows))
        yield from map(self.remember, super().draw(rows))

    def check_rows(self, rows: int) -> None:
        """Raise a `ValueError` if there are fewer rows than minibatches.

        Args:
            rows: number of them.
        """
        if rows < self.count:
            raise ValueError(
                f"minibatches={self.count} are more than the {rows} envs, but with a memory each "
                "needs all steps of an env; take fewer minibatches or more envs"
            )

    def remember(self, rows: TensorDictBase) -> TensorDictBase:
        """Return the steps of whole rows [N, T] with `remembered`, [N * T]."""
        with set_recurrent_mode(True):
            remembered = self.memory(rows.select(*self.memory.in_keys))[REMEMBERED]
        return rows.copy().set(REMEMBERED, remembered).reshape(-1)


def minibatches_of(
    memory: TensorDictModuleBase | None, epochs: int, count: int, seed: int
) -> Minibatches:
    """Return the minibatches for a policy, with a memory or without (None); see `Minibatches`."""
    if memory is None:
        return Minibatches(epochs, count, seed)
    return RowMinibatches(epochs, count, seed, memory)
