"""Answers that were given before."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor


class Answers:
    """Remembers what a function said of a row, and asks it only about rows that are new.

    Episodes begin in few states, and a guide is much slower to ask about one row than it is to look one up.

    Args:
        limit: beyond so many rows nothing more is remembered.
    """

    def __init__(self, limit: int = 256) -> None:
        self.limit = limit
        self.known: tuple[Tensor, Tensor] | None = None

    def __call__(self, data: TensorDictBase, ask: Callable[[TensorDictBase], Tensor]) -> Tensor:
        """What `ask` says of the data: [N, ...].

        Args:
            data: [N].
            ask: a function of each row by itself, from [M] to [M, ...].
        """
        rows = torch.cat(
            [leaf.reshape(len(data), leaf.shape[1:].numel()).double() for leaf in data.values(True, True)], 1
        )
        known, answers = self.known or (rows[:0], None)
        same = _same(rows, known)
        new = ~same.any(1)
        if len(known) + int(new.sum()) > self.limit:
            return ask(data)
        if new.any():
            fresh = rows[new]
            first = _same(fresh, fresh).int().argmax(1) == torch.arange(len(fresh), device=rows.device)
            given = ask(data[new])[first]
            known, answers = torch.cat([known, fresh[first]]), given if answers is None else torch.cat([answers, given])
            self.known, same = (known, answers), _same(rows, known)
        return ask(data) if answers is None else answers[same.int().argmax(1)]


def _same(rows: Tensor, others: Tensor) -> Tensor:
    """Which rows [N, D] equal which others [M, D]: [N, M] bool."""
    return (rows.unsqueeze(1) == others).all(-1)
