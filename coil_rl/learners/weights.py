"""The weights of a network as one vector, so that an update takes one operation for all of them."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn


class Weights:
    """All parameters of a module in one vector.

    The parameters of the module become views of it. So whoever computes with the module, saves it
    or loads it has the numbers of the vector, while an optimiser has one tensor to change.
    Gradients reach the vector where the module is `used`.

    Args:
        module: its parameters have one type.

    Attributes:
        vector: the numbers, [n].
    """

    def __init__(self, module: nn.Module) -> None:
        self.places: list[tuple[dict[str, Any], str]] = []
        for part in module.modules():
            own = part._parameters
            self.places += [(own, name) for name, each in own.items() if each is not None]
        parameters: list[nn.Parameter] = [table[name] for table, name in self.places]
        self.shapes = [parameter.shape for parameter in parameters]
        self.sizes = [parameter.numel() for parameter in parameters]
        flat = [parameter.detach().reshape(-1) for parameter in parameters]
        self.vector = nn.Parameter(torch.cat(flat))
        self._join()

    def _join(self) -> None:
        """Make the parameters views of the vector."""
        views = self._views(self.vector.detach())
        for (table, name), view in zip(self.places, views, strict=True):
            table[name].data = view

    def __deepcopy__(self, memo: dict[int, Any]) -> "Weights":
        """Return a copy whose vector is that of the copied module; PyTorch copies each alone."""
        copied = object.__new__(Weights)
        vars(copied).update(copy.deepcopy(vars(self), memo))
        copied._join()
        return copied

    def _views(self, vector: Tensor) -> list[Tensor]:
        parts = vector.split(self.sizes)
        return [part.view(shape) for part, shape in zip(parts, self.shapes, strict=True)]

    @contextmanager
    def used(self, *, fixed: bool = False) -> Iterator[None]:
        """Let the module compute with views of the vector, which get gradients unless `fixed`."""
        own = [table[name] for table, name in self.places]
        views = self._views(self.vector.detach() if fixed else self.vector)
        for (table, name), view in zip(self.places, views, strict=True):
            table[name] = view
        try:
            yield
        finally:
            for (table, name), parameter in zip(self.places, own, strict=True):
                table[name] = parameter
