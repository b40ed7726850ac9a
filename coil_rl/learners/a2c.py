"""Advantage actor-critic (paper equation 76; Mnih et al. 2016), in its synchronous form.

The probability of an action changes with its advantage over the critic's value of the state. Each
batch is used for one pass only, because the gradient holds for the policy that collected the batch:

    loss = -mean(log pi(a | s) A(s, a))
"""

from collections.abc import Sequence
from typing import Any

from tensordict import NestedKey, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import A2CLoss, LossModule

from coil_rl.learners.ppo import PPO, standardise
from coil_rl.schedules import Linear, Schedule


class A2C(PPO):
    """The A2C learner: PPO with the loss above and one pass over each batch.

    Args:
        env, in_keys, learning_rate, options: as for `PPO`.
        standardise: whether to standardise the advantages of a minibatch. The coefficients of other
            losses then do not depend on the scale of the reward.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        learning_rate: float | Schedule = Linear(3e-4, 0.0),
        standardise: bool = True,
        **options: Any,
    ) -> None:
        # Naming the options of the clipped loss here rejects them in `options`.
        super().__init__(env, in_keys, learning_rate=learning_rate, epochs=1, clip=1.0, **options)
        self.standardise = standardise

    def build_loss(self, clip: float, **options: Any) -> LossModule:
        """Return TorchRL's loss of policy and critic."""
        return A2CLoss(self.head, self.critic, **options)

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return TorchRL's losses of a minibatch [N]."""
        if self.standardise:
            minibatch = minibatch.copy().set("advantage", standardise(minibatch["advantage"]))
        return super().losses(minibatch)
