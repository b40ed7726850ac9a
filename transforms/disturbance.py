"""What stands between an agent and an ideal world: base of delays and noise, and the lag of a row.

A disturbance belongs to the env, whatever the method: what comes behind it in the chain, guides
too, sees the disturbed observation. A policy that is handed to a machine takes it off, as a machine
has its own delays.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec

from coil_rl.ranges import Interval, checked
from coil_rl.transforms.action_space import nested_key
from coil_rl.transforms.guide_transform import SeededGenerator
from coil_rl.transforms.link import Link

# Steps, each of which is kept for every row.
Lag = Annotated[int, Interval(ge=0, le=10_000)]


class Disturbance(Link):
    """Base class of transforms that disturb observations or actions; a `Chain` leaves them out."""


@checked
class Delay(Disturbance):
    """Base class of delays by a number of steps that each row draws anew for each episode.

    The past is kept in the data, as `(memory_key, ...)`, so it is in checkpoints too.

    Args:
        min_lag: smallest delay in steps.
        max_lag: largest delay in steps.
        seed: of the draws.
        memory_key: entry for the lag of each row, [*batch, 1], and for its past.

    Raises:
        ValueError: for `min_lag` above `max_lag`.
    """

    needs_past = True

    def __init__(self, min_lag: Lag, max_lag: Lag, seed: int, memory_key: NestedKey) -> None:
        if min_lag > max_lag:
            raise ValueError(
                f"min_lag={min_lag} must be at most max_lag={max_lag}; for a fixed delay give both "
                "the same number"
            )
        super().__init__(in_keys=[], out_keys=[])
        self.min_lag, self.max_lag = min_lag, max_lag
        self.memory_key: NestedKey = nested_key(memory_key)
        self.rng = SeededGenerator(seed)

    def _of_memory(self, *key: str) -> NestedKey:
        """Return the full key of an entry of the memory."""
        first = self.memory_key if isinstance(self.memory_key, tuple) else (self.memory_key,)
        return (*first, *key)

    def _drawn(self, tensordict: TensorDictBase) -> Tensor:
        """Return new lags [*batch, 1]; those of all rows are drawn, whichever of them begin."""

        def drawn(*shape: int, generator: torch.Generator) -> Tensor:
            return torch.randint(self.min_lag, self.max_lag + 1, shape, generator=generator)

        shape = (*tensordict.batch_size, 1)
        return self.rng.sample(drawn, shape).to(tensordict.device or "cpu")

    def _delay(self, data: TensorDictBase, key: NestedKey, past: Tensor, lag: Tensor) -> Tensor:
        """Replace an entry by that of some steps ago; return the past for the next step.

        Args:
            past: of the entry, [*batch, max_lag, *shape], oldest first.
            lag: steps, [*batch, 1], at most `max_lag`.
        """
        dim = data.ndim
        values = torch.cat([past, data[key].unsqueeze(dim)], dim)
        rest = values.shape[dim + 1 :]
        index = (self.max_lag - lag).reshape(*lag.shape, *(1 for _ in rest))
        data.set(key, values.gather(dim, index.expand(*lag.shape, *rest)).squeeze(dim))
        return values.narrow(dim, 1, self.max_lag)

    @property
    def state(self) -> Mapping[NestedKey, TensorSpec]:
        """The lag of each row and its past."""
        lag = self._of_rows(Bounded, 0, self.max_lag, dtype=torch.int64)
        specs: dict[NestedKey, TensorSpec] = {self._of_memory("lag"): lag}
        dim = len(self.parent.batch_size)
        for key, spec in self._kept().items():
            size = (*spec.shape[:dim], self.max_lag, *spec.shape[dim:])
            specs[key] = spec.unsqueeze(dim).expand(size).clone()
        return specs

    @abstractmethod
    def _kept(self) -> Mapping[NestedKey, TensorSpec]:
        """Return for each key of the memory the spec of what it keeps of one step."""

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the memory; raises a `ValueError` if it cannot be kept."""
        name = type(self).__name__
        if self.memory_key in observation_spec.keys(True):
            raise ValueError(
                f"{name} keeps the past in {self.memory_key!r}, which exists already; give each "
                "delay a memory_key of its own"
            )
        if "_reset" not in self.parent.reset_keys:
            raise ValueError(f"{name} needs one episode a row, but the env resets its agents alone")
        return super().transform_observation_spec(observation_spec)
