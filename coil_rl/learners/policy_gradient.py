"""Policy gradients: REINFORCE (Williams 1992) and advantage actor-critic, A2C (Mnih et al. 2016).

REINFORCE (paper equation 67): the probability of an action changes with the return G that followed
it, the discounted sum of the rewards from its step on. A baseline b that depends on the state only
is subtracted: it reduces the variance of the gradient and not its mean.

    loss = -mean(log pi(a | s) (G - b(s)))

An episode that goes on after the batch, or was truncated, is bootstrapped from the baseline of its
last state. Without a baseline its return ends with the batch, so batches should be long. Complete
episodes alone would give a bias, because their length depends on the actions.

A2C (paper equation 76), in its synchronous form, has the advantage over the critic's value of the
state in place of G - b. Each batch is used for one pass only, because the gradient holds for the
policy that collected the batch:

    loss = -mean(log pi(a | s) A(s, a))
"""

from collections.abc import Sequence
from typing import Literal, Unpack

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from coil_rl.learners.batches import standardise as standardised
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.networks import FastTensorDictModule
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


@checked
class Reinforce(A2C):
    """The REINFORCE learner: A2C with the whole return, lambda = 1.

    Args:
        baseline: "critic", a network that is trained on the returns, or "none".
        standardise: whether to standardise G - b in a minibatch. The coefficients of other losses
            then do not depend on the scale of the reward.
        settings: further ones of `PPO`.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        baseline: Literal["critic", "none"] = "critic",
        learning_rate: NonNegative | Schedule = Linear(1e-3, 0.0),
        compile: bool | Literal["auto"] = "auto",
        standardise: bool = True,
        **settings: Unpack[OnPolicySettings],
    ) -> None:
        self.baseline = baseline
        super().__init__(
            env,
            in_keys,
            learning_rate=learning_rate,
            gae_lambda=1.0,
            entropy=0.0,
            critic=float(baseline == "critic"),
            compile=compile,
            standardise=standardise,
            **settings,
        )

    def build_critic(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp
    ) -> TensorDictModuleBase:
        """Return the baseline."""
        if self.baseline == "critic":
            return super().build_critic(env, in_keys, network)
        key = in_keys[0]
        dims = len(env.observation_spec[key].shape) - len(env.batch_size)

        def zero(entry: Tensor) -> Tensor:
            return torch.zeros(*entry.shape[: entry.ndim - dims], 1, device=entry.device)

        return FastTensorDictModule(zero, [key], ["state_value"])
