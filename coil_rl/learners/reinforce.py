"""REINFORCE (paper equation 67; Williams 1992).

The probability of an action changes with the return G that followed it, the discounted sum of the
rewards from its step on. A baseline b that depends on the state only is subtracted: it reduces the
variance of the gradient and not its mean.

    loss = -mean(log pi(a | s) (G - b(s)))

An episode that goes on after the batch, or was truncated, is bootstrapped from the baseline of its
last state. Without a baseline its return ends with the batch, so batches should be long. Complete
episodes alone would give a bias, because their length depends on the actions.
"""

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.envs.limits import check_choice
from coil_rl.learners.a2c import A2C
from coil_rl.learners.anchor import Anchor
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.extension import Extension
from coil_rl.schedules import Linear, Schedule


class Reinforce(A2C):
    """The REINFORCE learner: A2C with the whole return, lambda = 1.

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
        minibatches: minibatches per pass.
        max_grad_norm: gradients are scaled down to this norm.
        compile: whether to compile the update, see `GradientStep`.
        anchor: makes the policy start as its guide.
        auxiliary: further extensions, such as losses of the policy (`KickstartLoss`).
        baseline: "critic", a network that is trained on the returns, or "none".
        standardise: whether to standardise G - b in a minibatch. The coefficients of other losses
            then do not depend on the scale of the reward.
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
        learning_rate: float | Schedule = Linear(1e-3, 0.0),
        gamma: float = 0.99,
        minibatches: int = 16,
        max_grad_norm: float = 0.5,
        compile: bool | Literal["auto"] = "auto",
        anchor: Anchor | None = None,
        auxiliary: Sequence[Extension] = (),
        baseline: Literal["critic", "none"] = "critic",
        standardise: bool = True,
        seed: int = 0,
    ) -> None:
        check_choice(("critic", "none"), baseline=baseline)
        self.baseline = baseline
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
            minibatches=minibatches,
            max_grad_norm=max_grad_norm,
            compile=compile,
            anchor=anchor,
            auxiliary=auxiliary,
            seed=seed,
            standardise=standardise,
            gae_lambda=1.0,
            entropy=0.0,
            critic=float(baseline == "critic"),
        )

    def build_critic(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp
    ) -> TensorDictModuleBase:
        """Return the baseline."""
        if self.baseline == "critic":
            return super().build_critic(env, in_keys, network)
        return ZeroCritic(in_keys)


class ZeroCritic(TensorDictModuleBase):
    """A critic that writes 0 as `state_value` [*batch, 1].

    Args:
        in_keys: entries that it reads, without effect.
    """

    def __init__(self, in_keys: Sequence[NestedKey]) -> None:
        self.in_keys, self.out_keys = list(in_keys), ["state_value"]
        super().__init__()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the value."""
        return tensordict.set(
            "state_value", torch.zeros(*tensordict.shape, 1, device=tensordict.device)
        )
