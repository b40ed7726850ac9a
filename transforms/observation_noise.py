"""Noise on observations, as of a sensor."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, MultiCategorical, OneHot, TensorSpec
from torchrl.envs import EnvBase, Transform

from coil_rl.ranges import NonNegative, checked
from coil_rl.transforms.action_space import nested_key
from coil_rl.transforms.disturbance import Disturbance
from coil_rl.transforms.guide_transform import DrawingLink, SeededGenerator
from coil_rl.transforms.link import State


@checked
class ObservationNoise(DrawingLink, Disturbance):
    """Observations with Gaussian noise, independent at every step, within the bounds of the entry.

    Noise takes no number out of its bounds; one that lies outside without it is noisy inwards only.
    Bounds are those of the spec, or what the env declares in `observation_bounds`.

    In front of `GuideActions` the guides see the noise too, where they read these entries; behind
    it only the agent does.

    Args:
        sigma: standard deviation in the unit of the entries.
        in_keys: entries of real numbers.
        seed: of the draws.

    Raises:
        ValueError: without entries; in an env also for one that does not exist or is not of real
            numbers.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> cars = ConeTrackEnv(shipped_tracks("train"), num_envs=8)
        >>> env = TransformedEnv(cars, ObservationNoise(0.1))
        >>> bool((env.reset()["observation"] == cars.start_observation.mT[:1]).all())
        False
    """

    def __init__(
        self,
        sigma: NonNegative = 0.1,
        in_keys: Sequence[NestedKey] = ("observation",),
        seed: int = 0,
    ) -> None:
        if not in_keys:
            raise ValueError("in_keys is empty; give the entries that are noisy")
        keys = [nested_key(key) for key in in_keys]
        super().__init__(in_keys=keys, out_keys=keys)
        self.sigma, self.rng = sigma, SeededGenerator(seed)

    @cached_property
    def bounds(self) -> dict[NestedKey, tuple[Tensor, Tensor]]:
        """Bounds of the entries that have any; empty outside an env."""
        env = self.parent
        if env is None:
            return {}
        specs, first = env.full_observation_spec, (0,) * len(env.batch_size)
        spaces = {key: specs[key].space for key in self.in_keys if isinstance(specs[key], Bounded)}
        bounds = {key: (space.low[first], space.high[first]) for key, space in spaces.items()}
        return self._declared(env) | bounds

    def _declared(self, env: EnvBase) -> dict[NestedKey, tuple[Tensor, Tensor]]:
        """Return the bounds that an env declares for the entries that no other transform writes."""
        found = getattr(env, "observation_bounds", {})
        found = found[0] if isinstance(found, list) else found  # of several envs in one
        changed: list[NestedKey] = []
        for part in env.modules():
            if isinstance(part, Transform) and not isinstance(part, Disturbance):
                changed += part.out_keys
        return {key: found[key] for key in self.in_keys if key in found and key not in changed}

    def observe(self, data: TensorDictBase, state: State) -> State:
        """Write the noisy entries; the state is their noise."""
        for key, draw in state.items():
            values = data[key]
            noisy = torch.add(values, draw.to(values), alpha=self.sigma)
            if key in self.bounds:
                low, high = self.bounds[key]
                noisy = noisy.clamp(values.minimum(low), values.maximum(high))
            data.set(key, noisy)
        return {}

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Check the entries; raises a `ValueError` for one that cannot be noisy."""
        specs = {key: observation_spec[key] for key in observation_spec.keys(True, True)}
        real = [key for key, spec in specs.items() if _is_real(spec)]
        for key in self.in_keys:
            if key not in real:
                raise ValueError(
                    f"ObservationNoise: in_keys has {key!r}, but the env writes these real "
                    f"numbers: {', '.join(map(repr, real))}"
                )
        return observation_spec


def _is_real(spec: TensorSpec) -> bool:
    """Return whether an entry is of real numbers: neither of whole ones nor of choices."""
    choices = isinstance(spec, (Categorical, MultiCategorical, OneHot))
    return not choices and (spec.dtype or torch.int).is_floating_point
