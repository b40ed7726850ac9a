"""SAC with other critics: CrossQ and TQC.

CrossQ (Bhatt et al. 2024): the critics normalise batches and have no target networks. They compute
the values of (s, a) and (s', b) in one batch, so that both are normalised by the same statistics:

    y = r + gamma (min Q(s', b) - alpha log pi(b | s')),  b from pi(. | s')

In the loss of the policy they are normalised by their running statistics. Differences from the
paper: the policy is updated with each minibatch, not with each third, its own layers are not
normalised, and the last layer of the critics is slowed down (`gain`).

TQC (truncated quantile critics, Kuznetsov et al. 2020): each critic gives n quantiles of the
return. The target is not the smaller of two values: the quantiles of all target networks are sorted
together, and the largest ones are left out, which controls how much values are overestimated. The
policy maximises the mean of all quantiles.
"""

from collections.abc import Sequence
from typing import Annotated, Unpack

import torch
from tensordict import NestedKey
from torch import Tensor
from torch.nn import functional as F
from torchrl.envs import EnvBase

from coil_rl.learners.policy import Entries, next_of
from coil_rl.learners.sac import SAC, CrossQSettings, SACSettings
from coil_rl.ranges import Interval, checked


@checked
class CrossQ(SAC):
    """The CrossQ learner.

    Args:
        env: the env, with continuous actions.
        in_keys: entries that policy and critics observe.
        critic_layer_norm: None, as it normalises batches; another value is a `ValueError`.
        tau: None, as it has no target networks; another value is a `ValueError`.
        settings: further ones of `SAC`.
    """

    betas = (0.5, 0.999)
    norm = "batch"
    with_target = False
    gain = 0.01  # with a fast last layer, and no target networks, values run away

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        critic_layer_norm: None = None,
        tau: None = None,
        **settings: Unpack[CrossQSettings],
    ) -> None:
        if critic_layer_norm is not None or tau is not None:
            raise ValueError(
                f"critic_layer_norm={critic_layer_norm} and tau={tau} must be None: CrossQ "
                "normalises batches and has no target networks"
            )
        super().__init__(env, in_keys, **settings)

    def critic_losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the loss of all critics."""
        with torch.no_grad():
            after, log_prob = self.acted(next_of(minibatch))
        both = {key: torch.cat([minibatch[key], after[key]]) for key in self.critics.in_keys}
        values, next_values = self.critics.outputs(Entries(both), train=True).chunk(2, 1)
        target = self.returns(minibatch, next_values.detach(), log_prob)
        return self.distances(values, target)


@checked
class TQC(SAC):
    """The TQC learner.

    Args:
        env: the env, with continuous actions.
        in_keys: entries that policy and critics observe.
        quantiles: n, of each critic.
        dropped: number of the largest quantiles that are left out for each critic, less than n.
        settings: of `SAC`, but `target_critics`: all critics give the target, otherwise that is a
            `ValueError`.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        quantiles: Annotated[int, Interval(ge=2, le=1_000)] = 25,
        dropped: Annotated[int, Interval(ge=0, le=1_000)] = 2,
        **settings: Unpack[SACSettings],
    ) -> None:
        if dropped >= quantiles:
            raise ValueError(f"dropped={dropped} must be less than quantiles={quantiles}")
        if settings.get("target_critics") is not None:
            raise ValueError("target_critics: all critics of TQC give the target; leave it out")
        self.values_of_a_critic, self.dropped = quantiles, dropped
        super().__init__(env, in_keys, **settings)
        self.levels = (torch.arange(quantiles, device=self.device) + 0.5) / quantiles

    def next_values(self, outputs: Tensor) -> Tensor:
        """Return the kept quantiles of the next state, [N, kept], from those of all critics."""
        every = outputs.movedim(0, 1).flatten(1).sort(-1).values
        return every[:, : every.shape[1] - self.dropped * len(outputs)]

    def values(self, outputs: Tensor) -> Tensor:
        """Return the mean of all quantiles, [N]."""
        return outputs.mean((0, 2))

    def distances(self, outputs: Tensor, target: Tensor) -> dict[str, Tensor]:
        """Return the loss of the quantile regression of all critics, with Huber's distance."""
        errors = target[:, None, :] - outputs[..., None]  # [critics, N, n, kept]
        huber = F.smooth_l1_loss(errors, torch.zeros_like(errors), reduction="none")
        below = (errors.detach() < 0).to(errors.dtype)
        weight = (self.levels[:, None] - below).abs()
        return {
            "loss_qvalue": (weight * huber).mean((1, 2, 3)).sum(),
            "value": outputs.detach().mean(),
        }
