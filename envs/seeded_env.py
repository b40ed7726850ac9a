"""An env that draws all its random numbers from a generator of its own."""

from typing import Any, ClassVar

import torch
from torch import Tensor
from torchrl.envs import EnvBase


class SeededEnv(EnvBase):
    """Env that draws all random numbers from `generator`, whose state is part of `state_dict`.

    Attributes:
        generator: of all random numbers.
        different: number of rows that draw where their episodes begin, of B; row i begins as row
            `i % different`. None: all rows draw.
        draws_in_steps: whether rows that begin alike and act alike draw different numbers later.
    """

    draws_in_steps: ClassVar[bool] = False

    generator: torch.Generator
    different: int | None = None

    def _drawn(self, high: int) -> Tensor:
        """Draw an integer below `high` for each row, the same for rows that begin alike, [B]."""
        rows = self.batch_size.numel()
        drawn = torch.randint(high, (self.different or rows,), generator=self.generator)
        return drawn if self.different is None else drawn[torch.arange(rows) % self.different]

    def __setattr__(self, name: str, value: Any) -> None:
        # For a buffer, the checks of PyTorch take longer than an operation on it.
        buffers = self.__dict__.get("_buffers", {})
        if name in buffers:
            buffers[name] = value
        else:
            super().__setattr__(name, value)

    def get_extra_state(self) -> Tensor:
        """Return the state of the generator."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the state of the generator."""
        self.generator.set_state(state.cpu())

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)
