"""What every regressor can do, whatever learns inside."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

from torch import Tensor, nn


class Regressor(nn.Module, ABC):
    """Learns vectors from vectors, each time anew; all of it is in its `state_dict`.

    As made by its constructor it is a description only: `fresh` makes one that can learn.
    """

    @abstractmethod
    def fresh(self, inputs: int, outputs: int) -> Self:
        """One that has not learned and predicts 0, from vectors of `inputs` numbers to vectors of `outputs`."""

    @abstractmethod
    def fit(self, x: Tensor, y: Tensor) -> None:
        """Forget everything and learn y [N, outputs] from x [N, inputs].

        What is learned follows from these and the constructor's arguments alone: a run that goes on needs no more.
        """

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """[*batch, inputs] to [*batch, outputs]."""
