"""The one form of a policy: modules that read and write entries by key, and a distribution.

The entries are a TensorDict, as TorchRL's collectors and losses give them, or a plain dictionary.
With a small network the searches of a TensorDict take longer than the arithmetic, so rollouts and
updates use the latter.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import (
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from coil_rl.learners.density import Density, Normal, padding
from coil_rl.learners.encoders import ObservationNetwork

UNCLIPPED = "unclipped_action"  # sample of a policy whose actions are clipped
NOISE = "exploration_noise"  # standard normal numbers that a rollout may write


class Entries(dict[NestedKey, Tensor]):
    """Entries by key, for modules that read one by its key and write one by `set`."""

    def set(self, key: NestedKey, value: Tensor) -> "Entries":
        """Write an entry."""
        self[key] = value
        return self

    def copy(self) -> "Entries":
        """Return the same entries, to which others can be added."""
        return Entries(self)


def read_through(inputs: TensorDictModuleBase | None, keys: Sequence[NestedKey]) -> list[NestedKey]:
    """Return the keys that a network reads in place of `keys`, behind `inputs` that change some."""
    names = {} if inputs is None else dict(zip(inputs.in_keys, inputs.out_keys, strict=True))
    return [names.get(key, key) for key in keys]


def next_of(entries: Entries) -> Entries:
    """Return the entries after a step by the keys of those before it."""
    return Entries(
        {
            unravel_key(key[1:]): value
            for key, value in entries.items()
            if isinstance(key, tuple) and key[0] == "next"
        }
    )


class KeyModule(TensorDictModuleBase):
    """Base class of modules that only read and write entries by key, so that `Entries` will do.

    Args:
        in_keys: entries that it reads.
        out_keys: entries that it writes.
    """

    def __init__(self, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]) -> None:
        self.in_keys: list[NestedKey] = list(in_keys)
        self.out_keys: list[NestedKey] = list(out_keys)
        super().__init__()


class Sample(ProbabilisticTensorDictModule):
    """The last module of a policy, which samples from its distribution.

    It writes the sample, and its logarithmic probability as `action_log_prob`: a random one while
    TorchRL's exploration type is random, with the numbers of `exploration_noise` if a rollout has
    written them; else the mode.

    Args:
        parameters: entries with the parameters of the distribution.
        key: entry for the sample.
        distribution: its class.
        options: further arguments of the distribution by name; None: there are none.
        action_key: entry for the action; None: the sample is the action.
    """

    def __init__(
        self,
        parameters: Sequence[NestedKey],
        key: NestedKey,
        distribution: type[Density],
        options: Mapping[str, Any] | None = None,
        action_key: NestedKey | None = None,
    ) -> None:
        super().__init__(
            list(parameters),
            [key],
            distribution_class=distribution,
            distribution_kwargs=dict(options or {}),
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )
        self.sample_key, self.action_key = key, action_key or key

    @property
    def out_keys(self) -> list[NestedKey]:
        """Keys of the entries that `forward` writes."""
        return list(dict.fromkeys([*super().out_keys, self.action_key]))

    def get_dist(self, tensordict: Any) -> Density:
        """Return the distribution of entries that have its parameters."""
        parameters = (tensordict[key] for key in self.in_keys)
        density: Density = self.distribution_class(*parameters, **self.distribution_kwargs)
        return density

    build_dist_from_params = get_dist

    def forward(self, tensordict: Any, *args: Any, **options: Any) -> Any:
        """Write the sample, its logarithmic probability and the action."""
        density = self.get_dist(tensordict)
        if exploration_type() is ExplorationType.RANDOM:
            sample, log_prob = density.draw(tensordict.get(NOISE, None))
        else:
            sample = density.mode
            log_prob = density.log_prob(sample)
        tensordict.set(self.sample_key, sample)
        tensordict.set("action_log_prob", log_prob)
        self.write_action(tensordict)
        return tensordict

    def write_action(self, entries: Any) -> None:
        """Write the action of the sample in some entries, unless the sample is the action."""


class ClippedSample(Sample):
    """Sample of normal numbers, clipped to the bounds of an action.

    It writes `unclipped_action`, the sample, with `action_log_prob`, and the action, which the env
    executes.

    Args:
        low: lower bounds, of the shape of an action.
        high: upper bounds, of the shape of an action.
        action_key: entry for the action.
    """

    def __init__(self, low: Tensor, high: Tensor, action_key: NestedKey = "action") -> None:
        options = {"event_dims": low.ndim}
        super().__init__(["loc", "scale"], UNCLIPPED, Normal, options, action_key)
        self.low, self.high = low, high

    def write_action(self, entries: Any) -> None:
        """Write the action, the clipped sample, in some entries [*batch]."""
        entries.set(self.action_key, entries[UNCLIPPED].clamp(self.low, self.high))


def by_key(module: nn.Module) -> bool:
    """Return whether a module only reads and writes by key, so that `Entries` will do."""
    if isinstance(module, Policy | ByKey):
        return all(map(by_key, module.module))
    return isinstance(module, KeyModule | Sample)


class ByKey(TensorDictSequential):
    """Modules one after the other, which may read and write `Entries`."""

    def forward(self, tensordict: Any, *args: Any, **options: Any) -> Any:
        """Write what the modules write."""
        for module in self.module:
            tensordict = module(tensordict)
        return tensordict


class Policy(ProbabilisticTensorDictSequential):
    """A policy: modules one after the other, of which the last one samples.

    Each reads and writes entries; the last one is a `Sample`, or one of TorchRL.
    """

    forward = ByKey.forward

    def density(self, entries: Any) -> Any:
        """Return the distribution of entries, which get what the modules before it write."""
        *before, last = self.module
        for module in before:
            entries = module(entries)
        return last.get_dist(entries)


class GlobalScaleHead(nn.Module):
    """Normal distribution with a mean from a network, and one standard deviation for all states.

    Args:
        network: gives the mean of each number of an action.
        event: shape of an action.
        scale: initial standard deviation.
    """

    outputs = 1  # of the network for each number of an action

    def __init__(self, network: ObservationNetwork, event: torch.Size, scale: float) -> None:
        super().__init__()
        self.network, self.event = network, event
        self.log_scale = nn.Parameter(
            torch.full(event, math.log(scale), device=next(network.parameters()).device)
        )

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [*batch, *event] each."""
        loc = shaped(self.network(*inputs), self.event)
        return loc, self.log_scale.exp().to(loc.dtype).expand_as(loc)


class GaussianHead(nn.Module):
    """Normal distribution with mean and standard deviation from a network.

    Args:
        network: gives the means of the numbers of an action, then as many outputs that become
            standard deviations.
        event: shape of an action.
        scale: standard deviation where the network gives 0.
    """

    outputs = 2

    def __init__(self, network: ObservationNetwork, event: torch.Size, scale: float) -> None:
        super().__init__()
        self.network, self.event = network, event
        self.split = NormalParamExtractor(f"biased_softplus_{scale}", scale_lb=1e-3)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation, [*batch, *event] each."""
        loc, scale = self.split(self.network(*inputs))
        return shaped(loc, self.event), shaped(scale, self.event)


class ChoicesHead(nn.Module):
    """Logits of several choices at once from a network.

    They are padded to the longest choice with a number so low that its probability is exactly 0. It
    is finite, because a number that is not in recorded data is a fault.

    Args:
        network: gives logits for all choices, of each as many as the longest one has.
        event: shape of an action, which is one index for each choice.
        options: number of options of each choice, of shape `event`.
    """

    def __init__(self, network: ObservationNetwork, event: torch.Size, options: Tensor) -> None:
        super().__init__()
        self.network, self.event = network, event
        longest = torch.arange(int(options.max()), device=options.device)
        self.valid: Tensor = nn.Buffer(longest < options.unsqueeze(-1), persistent=False)

    def forward(self, *inputs: Tensor) -> Tensor:
        """Return the logits, [*batch, *event, n]."""
        logits = shaped(self.network(*inputs), self.valid.shape)
        return logits.masked_fill(~self.valid, padding(logits.dtype))


def shaped(vectors: Tensor, event: torch.Size) -> Tensor:
    """Return vectors [*batch, n] as [*batch, *event]."""
    return vectors.reshape(*vectors.shape[:-1], *event)
