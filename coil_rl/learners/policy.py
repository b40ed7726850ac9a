"""The one form of a policy: modules that read and write entries by key, and a distribution.

The entries are a TensorDict, as TorchRL's collectors and losses give them, or a plain dictionary.
With a small network the searches of a TensorDict take longer than the arithmetic, so rollouts and
updates use the latter.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from tensordict import NestedKey, unravel_key
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type

from coil_rl.learners.density import Density, Normal

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

    by_key: ClassVar[bool] = True

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
    if isinstance(module, TensorDictSequential):
        return isinstance(module, Policy | ByKey) and all(map(by_key, module.module))
    return bool(getattr(module, "by_key", False))


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
