"""ADVISOR (Weihs et al. 2021): PPO where imitation of the guide cannot work, else imitation.

An auxiliary policy pi_aux with the agent's observation learns by imitation only. Where it cannot
predict the guide's action g, the guide knows something that the agent does not see, and the agent
learns from reward. For each step

    loss = w * (-log pi(g | s)) + (1 - w) * loss of PPO,  w = exp(-alpha D),

with D = -log pi_aux(g | s) for discrete actions, and for numbers the largest distance of g from the
mode of pi_aux.
"""

from collections.abc import Sequence
from typing import Any, Unpack

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.learners import networks
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.kickstart import KickstartLoss
from coil_rl.learners.policy import Entries, Policy
from coil_rl.learners.ppo import PPO, PPOSettings
from coil_rl.ranges import NonNegative, checked


@checked
class Advisor(PPO):
    """The ADVISOR learner; errors are those of `PPO`.

    Args:
        env: the env, with advice.
        in_keys: entries that the policies and the critic observe.
        alpha: the larger, the better a step must be imitated to be learned by imitation.
        guide: index of the guide in the advice.
        settings: further ones of `PPO`; a network without a memory.
    """

    with_memory = False
    parts = (*PPO.parts, "imitator")

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        alpha: NonNegative = 8.0,
        guide: int = 0,
        **settings: Unpack[PPOSettings],
    ) -> None:
        self.alpha, self.imitation = alpha, KickstartLoss(guide=guide)
        super().__init__(env, in_keys, **settings)
        self.imitation.meet(env, self.head, None)
        self.keys += self.imitation.keys
        self.minibatch_keys += self.imitation.keys

    def build_policy(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp, **options: Any
    ) -> Policy:
        """Return the policy, and make the auxiliary one."""
        self.imitator = networks.actor(env, in_keys, network, inputs=self.inputs)
        return super().build_policy(env, in_keys, network, **options)

    def parameter_groups(self) -> list[list[nn.Parameter]]:
        """Return the parameters that the optimiser updates."""
        return [*super().parameter_groups(), [*self.imitator.parameters()]]

    def losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the losses of `PPO` with another `loss_objective`, `loss_imitation`, and `weight`.

        `loss_objective` is the weighted sum of both losses, `weight` the mean of w, and
        `loss_imitation` the loss of the auxiliary policy.
        """
        steps = TensorDict(dict(minibatch), len(minibatch["advantage"]))
        predicted = self.imitation.each(self.imitator, steps)
        weight = (-self.alpha * self.distance(steps, predicted.detach())).exp()
        imitation = self.imitation.each(self.head, steps)
        losses = super().losses(
            Entries({**minibatch, "weight": weight, "loss_of_imitation": imitation})
        )
        losses["loss_imitation"] = predicted.mean()
        losses["loss_objective"] = losses["loss_objective"] + losses["loss_imitation"]
        losses["weight"] = weight.mean()
        return losses

    def objective(self, log_prob: Tensor, minibatch: Entries) -> Tensor:
        """Return the loss of the policy in each step of a minibatch [N]."""
        weight = minibatch["weight"]
        own = super().objective(log_prob, minibatch)
        return weight * minibatch["loss_of_imitation"] + (1 - weight) * own

    @torch.no_grad()
    def distance(self, minibatch: TensorDictBase, surprise: Tensor) -> Tensor:
        """Return D [N]; `surprise` is -log pi_aux(g | s)."""
        if not minibatch["action"].is_floating_point():
            return surprise
        mode = self.imitator.get_dist(minibatch.select(*self.imitator.in_keys)).mode
        difference: Tensor = minibatch["guide_action"][..., self.imitation.guide, :] - mode
        return difference.abs().flatten(1).amax(1)
