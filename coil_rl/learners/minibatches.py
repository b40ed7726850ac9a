"""Minibatches: how a batch of rollouts is divided for the steps of the optimiser."""

from collections.abc import Iterator, Sequence
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import set_recurrent_mode

from coil_rl.learners.networks import REMEMBERED
from coil_rl.learners.policy import Entries
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

    def rows(self, batch: TensorDictBase, keys: Sequence[NestedKey]) -> Entries:
        """Return what minibatches are drawn from: entries of the steps of a batch, [B * T]."""
        return Entries({key: batch[key].flatten(0, batch.ndim - 1) for key in keys})

    def draw(self, rows: Entries) -> Iterator[Entries]:
        """Yield the minibatches [N] of all passes over `rows`.

        Raises:
            ValueError: if there are too few rows.
        """
        advantage = rows["advantage"]
        size = len(advantage) // self.count
        if size * advantage.shape[1:].numel() < 2:  # one advantage cannot be standardised
            raise ValueError(
                f"minibatches={self.count} leaves less than 2 of {advantage.numel()} frames to each"
            )
        for _ in range(self.epochs):
            order = torch.randperm(len(advantage), generator=self.generator)[: size * self.count]
            for index in order.to(advantage.device).split(size):
                yield Entries({key: rows[key].index_select(0, index) for key in rows})


class RowMinibatches(Minibatches):
    """Random minibatches of whole rows of a batch, for a policy with a memory.

    The GRU is run again from the stored first state of each row, so that gradients flow through
    time. After that the steps are a minibatch as any other.

    Args:
        memory: the part of the policy up to its GRU; it writes `remembered`.
    """

    def __init__(self, epochs: int, count: int, seed: int, memory: TensorDictModuleBase) -> None:
        super().__init__(epochs, count, seed)
        self.memory = memory

    def rows(self, batch: TensorDictBase, keys: Sequence[NestedKey]) -> Entries:
        """Return what minibatches are drawn from: entries of the rows of a batch, [B, T]."""
        rows = batch.select(*keys).reshape(-1, batch.shape[-1])
        return Entries({key: rows[key] for key in keys})

    def draw(self, rows: Entries) -> Iterator[Entries]:
        """Yield the minibatches [N] of all passes over `rows`.

        Raises:
            ValueError: if there are fewer rows than minibatches, or a minibatch would have less
                than two steps.
        """
        self.check_rows(len(rows["advantage"]))
        yield from map(self.remember, super().draw(rows))

    def check_rows(self, rows: int) -> None:
        """Raise a `ValueError` if there are fewer rows than minibatches."""
        if rows < self.count:
            raise ValueError(
                f"minibatches={self.count} are more than the {rows} envs, but with a memory each "
                "needs all steps of an env; take fewer minibatches or more envs"
            )

    def remember(self, rows: Entries) -> Entries:
        """Return the steps of whole rows [N, T] with `remembered`, [N * T]."""
        read = {key: rows[key] for key in self.memory.in_keys}
        with set_recurrent_mode(True):
            remembered = self.memory(TensorDict(read, rows["advantage"].shape[:2]))[REMEMBERED]
        rows.set(REMEMBERED, remembered)
        return Entries({key: each.flatten(0, 1) for key, each in rows.items()})


def minibatches_of(
    memory: TensorDictModuleBase | None, epochs: int, count: int, seed: int
) -> Minibatches:
    """Return the minibatches for a policy, with a memory or without (None); see `Minibatches`."""
    if memory is None:
        return Minibatches(epochs, count, seed)
    return RowMinibatches(epochs, count, seed, memory)
