"""REINFORCE (paper equation 67; Williams 1992).

The probability of an action changes with the return G that followed it, the discounted sum of the rewards from its step
on. A baseline b that depends on the state only is subtracted: it reduces the variance of the gradient and not its mean.

    loss = -mean(log pi(a | s) (G - b(s)))

An episode that goes on after the batch, or was truncated, is bootstrapped from the baseline of its last state. Without
a baseline its return ends with the batch, so batches should be long. Complete episodes alone would give a bias, because
their length depends on the actions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase
from torchrl.objectives import ReinforceLoss

from coil_rl.envs.limits import check_choice
from coil_rl.learners import networks
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.ppo import PPO, standardise


class Reinforce(PPO):
    """The REINFORCE learner: PPO with the loss above and one pass over each batch.

    Args:
        env: the env, for its specs.
        in_keys: entries that policy and baseline observe.
        baseline: "critic", a network trained on the returns, or "none".
        standardise: whether to standardise G - b in a minibatch.
        options: as for `PPO`.
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        baseline: Literal["critic", "none"] = "critic",
        standardise: bool = True,
        **options: Any,
    ) -> None:
        check_choice(("critic", "none"), baseline=baseline)
        self.baseline, self.standardise = baseline, standardise
        # With lambda = 1 the advantage is the return minus the value of the state. The clipped loss is replaced.
        super().__init__(
            env, in_keys, gae_lambda=1.0, epochs=1, clip=1.0, entropy=0.0, critic=1.0, compile=False, **options
        )
        self.loss = ReinforceLoss(self.head, self.critic, loss_critic_type="l2", functional=False)

    def build_networks(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp, **options: Any
    ) -> tuple[ProbabilisticTensorDictSequential, TensorDictModuleBase]:
        """Return policy and baseline."""
        if self.baseline == "critic":
            return super().build_networks(env, in_keys, network, **options)
        return networks.actor(env, in_keys, network, normaliser=self.normaliser, **options), ZeroCritic(in_keys)

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return TorchRL's losses of a minibatch [N], with the names of its other losses."""
        if self.standardise:
            minibatch = minibatch.copy().set("advantage", standardise(minibatch["advantage"]))
        losses = super().losses(minibatch)
        losses.rename_key_("loss_actor", "loss_objective")
        losses.rename_key_("loss_value", "loss_critic")
        return losses if self.baseline == "critic" else losses.set("loss_critic", losses["loss_critic"] * 0)


class ZeroCritic(TensorDictModuleBase):
    """A critic that writes 0 as `state_value` [*batch, 1]."""

    def __init__(self, in_keys: Sequence[NestedKey]) -> None:
        self.in_keys, self.out_keys = list(in_keys), ["state_value"]
        super().__init__()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the value."""
        return tensordict.set("state_value", torch.zeros(*tensordict.shape, 1, device=tensordict.device))
