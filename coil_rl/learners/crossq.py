"""CrossQ (Bhatt et al. 2024): SAC whose critics normalise batches and have no target networks.

The critics compute the values of (s, a) and (s', b) in one batch, so that both are normalised by
the same statistics:

    y = r + gamma (min Q(s', b) - alpha log pi(b | s')),  b from pi(. | s')

In the loss of the policy they are normalised by their running statistics. Differences from the
paper: the policy is updated with each minibatch, not with each third, its own layers are not
normalised, and the last layer of the critics is slowed down (`gain`).
"""

from collections.abc import Sequence
from typing import Unpack

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.learners.policy import Entries, next_of
from coil_rl.learners.sac import SAC, CrossQSettings
from coil_rl.ranges import checked


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
