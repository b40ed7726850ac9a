"""An env that draws all its random numbers from a generator of its own."""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, make_composite_from_td


class SeededEnv(EnvBase):
    """Env that draws all random numbers from `generator`, whose state is part of `state_dict`.

    Attributes:
        generator: of all random numbers.
        different: number of rows that draw, of B; row i gets what row `i % different` draws, so
            that rows that act alike have the same episode. None: all rows draw.
    """

    generator: torch.Generator
    different: int | None = None

    def _drawn(self, high: int) -> Tensor:
        """Draw an integer below `high` for each row, [B]."""
        return self._for_all_rows(
            torch.randint(high, (self._drawing_rows,), generator=self.generator)
        )

    @property
    def _drawing_rows(self) -> int:
        """Number of rows that draw."""
        return self.different or self.batch_size.numel()

    def _for_all_rows(self, drawn: Tensor) -> Tensor:
        """Return for all rows, [B, ...], what those that draw have drawn."""
        rows = self.batch_size.numel()
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


def declare_specs(env: EnvBase, example: TensorDictBase) -> None:
    """Set the specs of an env in a world with cones.

    Args:
        env: with an action [B, 1].
        example: of its entries after a reset.
    """
    batch, device, dtype = env.batch_size, env.device, example["observation"].dtype
    spec = make_composite_from_td(example, unsqueeze_null_shapes=False)
    for key in ("observation", "steering"):
        spec[key] = Bounded(-1, 1, example[key].shape, device=device, dtype=dtype)
    env.observation_spec = spec
    env.action_spec = Bounded(-1, 1, (*batch, 1), device=device, dtype=dtype)
    env.reward_spec = Unbounded((*batch, 1), device=device, dtype=dtype)
    flag = Binary(1, shape=(*batch, 1), dtype=torch.bool, device=device)
    ends = dict.fromkeys(("done", "terminated", "truncated"), flag)
    env.done_spec = Composite(ends, shape=batch, device=device)
