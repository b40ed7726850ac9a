"""Advantage actor-critic (paper equation 76; Mnih et al. 2016), in its synchronous form.

The probability of an action changes with its advantage over the critic's value of the state. Each
batch is used for one pass only, because the gradient holds for the policy that collected the batch:

    loss = -mean(log pi(a | s) A(s, a))
"""

from collections.abc import Sequence
from typing import Literal

from tensordict import NestedKey, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import A2CLoss, LossModule

from coil_rl.learners.advantages import standardise as standardised
from coil_rl.learners.anchor import Anchor
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.extension import Extension
from coil_rl.learners.ppo import PPO
from coil_rl.schedules import Linear, Schedule


class A2C(PPO):
    """The A2C learner: PPO with the loss above and one pass over each batch.

    Args:
        env: the env, for its specs.
        in_keys: entries that policy and critic observe.
        hidden: widths of the hidden layers of both networks, without `network`.
        network: architecture of both networks; None: `Mlp(hidden)`.
        normalise: whether to normalise what is observed, "auto" to decide it on the first batch, or
            the entries to normalise, see `Normaliser`.
        scale_rewards: whether rewards are divided by the running deviation of returns, see
            `RewardScale`.
        action_scale: initial standard deviation of the policy.
        action_gain: initial scale of the last weights of the policy; with 0 its mean is 0
            everywhere.
        squash: whether bounded actions are squashed by tanh; otherwise samples beyond the bounds
            are clipped.
        learning_rate: of Adam, a number or a schedule.
        gamma: discount.
        gae_lambda: lambda of generalised advantage estimation.
        minibatches: minibatches per pass.
        entropy: coefficient of the entropy bonus, a number or a schedule.
        critic: coefficient of the critic's loss.
        max_grad_norm: gradients are scaled down to this norm.
        compile: whether to compile the update, see `GradientStep`.
        anchor: makes the policy start as its guide.
        auxiliary: further extensions, such as losses of the policy (`KickstartLoss`).
        standardise: whether to standardise the advantages of a minibatch. The coefficients of other
            losses then do not depend on the scale of the reward.
        seed: of the order of minibatches.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        network: Mlp | None = None,
        normalise: bool | Literal["auto"] | Sequence[NestedKey] = False,
        scale_rewards: bool = False,
        action_scale: float = 0.5,
        action_gain: float = 0.01,
        squash: bool = True,
        learning_rate: float | Schedule = Linear(3e-4, 0.0),
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        minibatches: int = 16,
        entropy: float | Schedule = 0.0,
        critic: float = 0.5,
        max_grad_norm: float = 0.5,
        compile: bool | Literal["auto"] = "auto",
        anchor: Anchor | None = None,
        auxiliary: Sequence[Extension] = (),
        standardise: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__(
            env,
            in_keys,
            hidden=hidden,
            network=network,
            normalise=normalise,
            scale_rewards=scale_rewards,
            action_scale=action_scale,
            action_gain=action_gain,
            squash=squash,
            learning_rate=learning_rate,
            gamma=gamma,
            gae_lambda=gae_lambda,
            minibatches=minibatches,
            entropy=entropy,
            critic=critic,
            max_grad_norm=max_grad_norm,
            compile=compile,
            anchor=anchor,
            auxiliary=auxiliary,
            seed=seed,
            epochs=1,
        )
        self.standardise = standardise

    def build_loss(self, clip: float, critic: float) -> LossModule:
        """Return TorchRL's loss of policy and critic; nothing is clipped."""
        return A2CLoss(
            self.head,
            self.critic,
            entropy_bonus=self.entropy(0) > 0,
            entropy_coeff=self.entropy(0),
            critic_coeff=critic,
            loss_critic_type="l2",
            functional=False,
        )

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return TorchRL's losses of a minibatch [N]."""
        if self.standardise:
            minibatch = minibatch.copy().set("advantage", standardised(minibatch["advantage"]))
        return super().losses(minibatch)
