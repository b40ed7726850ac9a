"""Observations that come late, as from a sensor, a network or a slow perception."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from tensordict import NestedKey, TensorDictBase
from torchrl.data import NonTensor, TensorSpec

from coil_rl.transforms.action_space import nested_key
from coil_rl.transforms.disturbance import Delay, Lag
from coil_rl.transforms.link import State

INFO = "info"  # of the entries for measures, which nobody acts on


class ObservationDelay(Delay):
    """Observations of an earlier step; at first the first observation of the episode.

    Each row draws its delay for each episode, uniformly from `min_lag` to `max_lag` steps. All
    entries of a row are equally late. In front of `GuideActions` the guides see the late
    observation too; behind it only the agent does.

    Args:
        in_keys: entries that are late; None for the numbers that the env itself writes, without
            those under `info` and those that a transform before this one has taken out.
        memory_key: entry for the lag of each row and for its past observations, oldest first.

    Raises:
        ValueError: for `min_lag` above `max_lag`; in an env also for an entry that does not
            exist or has no numbers.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> cars = ConeTrackEnv(shipped_tracks("train"), num_envs=8)
        >>> env = TransformedEnv(cars, ObservationDelay(min_lag=1, max_lag=3))
        >>> env.reset()["late_observations", "lag"].shape
        torch.Size([8, 1])
    """

    def __init__(
        self,
        min_lag: Lag = 0,
        max_lag: Lag = 2,
        in_keys: Sequence[NestedKey] | None = None,
        seed: int = 0,
        memory_key: NestedKey = "late_observations",
    ) -> None:
        super().__init__(min_lag, max_lag, seed, memory_key)
        self.given_keys = None if in_keys is None else [nested_key(key) for key in in_keys]

    @cached_property
    def late_keys(self) -> list[NestedKey]:
        """The keys of the entries that are late."""
        specs = self.parent.full_observation_spec
        known = [key for key in specs.keys(True, True) if not isinstance(specs[key], NonTensor)]
        if self.given_keys is None:
            own = list(self.parent.base_env.full_observation_spec.keys(True, True))
            return [key for key in known if key in own and INFO not in (key, key[0])]
        for key in self.given_keys:
            if key not in known:
                raise ValueError(
                    f"ObservationDelay: in_keys has {key!r}, but the env writes these numbers: "
                    f"{', '.join(map(repr, known))}"
                )
        return self.given_keys

    def _past_key(self, key: NestedKey) -> NestedKey:
        return self._of_memory("past", *((key,) if isinstance(key, str) else key))

    def _kept(self) -> dict[NestedKey, TensorSpec]:
        specs = self.parent.full_observation_spec
        return {self._past_key(key): specs[key] for key in self.late_keys}

    def first(self, data: TensorDictBase, reset: TensorDictBase | None = None) -> State:
        """Draw the lags; the past is the first observation."""
        state = {self._of_memory("lag"): self._drawn(data)}
        for key in self.late_keys:
            first = data[key].unsqueeze(data.ndim)
            state[self._past_key(key)] = first.repeat_interleave(self.max_lag, data.ndim)
        return state

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the late entries, and keep the new ones."""
        lag = self._of_memory("lag")
        after = {lag: state[lag]}
        for key in self.late_keys:
            past = self._past_key(key)
            after[past] = self._delay(data, key, state[past], state[lag])
        return after
