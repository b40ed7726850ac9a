"""Advantage actor-critic (paper equation 76; Mnih et al. 2016), in its synchronous form.

The probability of an action changes with its advantage over the critic's value of the state. Each
batch is used for one pass only, because the gradient holds for the policy that collected the batch:

    loss = -mean(log pi(a | s) A(s, a))
"""

from collections.abc import Sequence
from typing import Literal, Unpack

from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.learners.minibatches import standardise as standardised
from coil_rl.learners.policy import Entries
from coil_rl.learners.ppo import PPO, OnPolicySettings
from coil_rl.ranges import NonNegative, Share, checked
from coil_rl.schedules import Linear, Schedule


@checked
class A2C(PPO):
    """The A2C learner: PPO with the loss above and one pass over each batch.

    Args:
        standardise: whether to standardise the advantages of a minibatch. The coefficients of other
            losses then do not depend on the scale of the reward.
        settings: further ones of `PPO`.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        learning_rate: NonNegative | Schedule = Linear(3e-4, 0.0),
        gae_lambda: Share = 0.95,
        entropy: NonNegative | Schedule = 0.0,
        critic: NonNegative = 0.5,
        compile: bool | Literal["auto"] = "auto",
        standardise: bool = True,
        **settings: Unpack[OnPolicySettings],
    ) -> None:
        super().__init__(
            env,
            in_keys,
            learning_rate=learning_rate,
            gae_lambda=gae_lambda,
            entropy=entropy,
            critic=critic,
            compile=compile,
            epochs=1,
            **settings,
        )
        self.standardise = standardise

    def objective(self, log_prob: Tensor, minibatch: Entries) -> Tensor:
        """Return the loss of the policy in each step of a minibatch [N]; nothing is clipped."""
        advantage = minibatch["advantage"]
        if self.standardise:
            advantage = standardised(advantage)
        return -(log_prob * advantage.squeeze(-1))

    def losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the losses of a minibatch [N]; there is no ratio to report."""
        return {name: each for name, each in super().losses(minibatch).items() if not each.ndim}
