"""Envs whose chance is their own: all draws come from one generator that is part of their state."""

from __future__ import annotations

import torch
from torch import Tensor
from torchrl.envs import EnvBase


class SeededEnv(EnvBase):
    """An env with a `generator`, which a constructor makes before it sets the seed."""

    generator: torch.Generator

    def get_extra_state(self) -> Tensor:
        """The generator's state, so that `state_dict` also holds what is yet to be drawn."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the generator."""
        self.generator.set_state(state.cpu())

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)
