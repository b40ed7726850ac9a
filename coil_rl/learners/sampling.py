"""Modules of a policy that sample an action from its distribution."""

from collections.abc import Mapping, Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import IndependentNormal, SafeProbabilisticModule

UNCLIPPED = "unclipped_action"  # sample of a policy whose actions are clipped
NOISE = "exploration_noise"  # standard normal numbers that a rollout may write


class Sample(SafeProbabilisticModule):
    """Module that samples from a distribution.

    It writes the sample, and its logarithmic probability as `action_log_prob`. If a rollout has
    written `exploration_noise`, standard normal numbers, a normal distribution takes these.

    Args:
        parameters: entries with the parameters of the distribution.
        key: entry for the sample.
        distribution: its class.
        options: further arguments of the distribution by name; None: there are none.
    """

    def __init__(
        self,
        parameters: Sequence[str],
        key: NestedKey,
        distribution: type,
        options: Mapping[str, Any] | None = None,
    ) -> None:
        self.read, self.distribution, self.options = list(parameters), distribution, options
        self.sample_key = key
        super().__init__(
            list(parameters),
            [key],
            distribution_class=distribution,
            distribution_kwargs=dict(options or {}),
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )

    def write_action(self, entries: Any) -> None:
        """Write the action of the sample in some entries, unless the sample is the action.

        Args:
            entries: a TensorDict or `Entries`, [*batch].
        """

    def forward(self, tensordict: TensorDictBase, *args: Any, **options: Any) -> TensorDictBase:
        """Write the sample and its logarithmic probability."""
        noise = tensordict.get(NOISE, None)
        if noise is None or exploration_type() is not ExplorationType.RANDOM:
            return super().forward(tensordict, *args, **options)
        distribution = self.get_dist(tensordict)
        sample = tensordict["loc"] + tensordict["scale"] * noise
        for transform in getattr(distribution, "transforms", ()):
            sample = transform(sample)
        return tensordict.set(self.out_keys[0], sample).set(
            "action_log_prob", distribution.log_prob(sample)
        )


class ClippedNormal(Sample):
    """Sample of a normal distribution, clipped to the bounds of an action.

    It writes `unclipped_action`, the sample, with `action_log_prob`, and the action, which the env
    executes.

    Args:
        low: lower bounds, of the shape of an action.
        high: upper bounds, of the shape of an action.
        action_key: entry for the action.
    """

    def __init__(self, low: Tensor, high: Tensor, action_key: NestedKey = "action") -> None:
        super().__init__(["loc", "scale"], UNCLIPPED, IndependentNormal, {"event_dim": low.ndim})
        self.low, self.high, self.action_key = low, high, action_key

    @property
    def out_keys(self) -> list[NestedKey]:
        """Keys of the entries that `forward` writes."""
        return [*super().out_keys, self.action_key]

    def forward(self, tensordict: TensorDictBase, *args: Any, **options: Any) -> TensorDictBase:
        """Write the sample and the action."""
        tensordict = super().forward(tensordict, *args, **options)
        self.write_action(tensordict)
        return tensordict

    def write_action(self, entries: Any) -> None:
        """Write the action, the clipped sample, of some entries [*batch]."""
        entries.set(self.action_key, entries[UNCLIPPED].clamp(self.low, self.high))
