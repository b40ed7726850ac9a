"""ADVISOR (Weihs et al. 2021): PPO where imitation of the guide cannot work, else imitation.

An auxiliary policy pi_aux with the agent's observation learns by imitation only. Where it cannot
predict the guide's action g, the guide knows something that the agent does not see, and the agent
learns from reward. For each step

    loss = w * (-log pi(g | s)) + (1 - w) * loss of PPO,  w = exp(-alpha D),

with D = -log pi_aux(g | s) for discrete actions, and for numbers the largest distance of g from the
mode of pi_aux.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.envs.limits import check_range
from coil_rl.learners import networks
from coil_rl.learners.advantages import standardise
from coil_rl.learners.anchor import Anchor
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.extension import Extension
from coil_rl.learners.kickstart import KickstartLoss
from coil_rl.learners.ppo import PPO
from coil_rl.schedules import Linear, Schedule


class Advisor(PPO):
    """The ADVISOR learner; errors are those of `PPO`.

    Args:
        env: the env, with advice.
        in_keys: entries that the policies and the critic observe.
        alpha: the larger, the better a step must be imitated to be learned by imitation.
        guide: index of the guide in the advice.
        hidden: widths of the hidden layers of all networks, without `network`.
        network: architecture of the networks, without a memory; None: `Mlp(hidden)`.
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
        clip: clipping range of the probability ratio.
        epochs: passes over each batch.
        minibatches: minibatches per pass.
        entropy: coefficient of the entropy bonus, a number or a schedule.
        critic: coefficient of the critic's loss.
        max_grad_norm: gradients are scaled down to this norm.
        compile: whether to compile the update, see `GradientStep`.
        anchor: makes the policy start as its guide.
        auxiliary: further extensions, such as losses of the policy (`KickstartLoss`).
        seed: of the order of minibatches.
    """

    with_memory = False
    parts = (*PPO.parts, "imitator")

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        alpha: float = 8.0,
        guide: int = 0,
        hidden: Sequence[int] = (64, 64),
        network: Mlp | None = None,
        normalise: bool | Literal["auto"] | Sequence[NestedKey] = False,
        scale_rewards: bool = False,
        action_scale: float = 0.5,
        action_gain: float = 0.01,
        squash: bool = True,
        learning_rate: float | Schedule = Linear(1e-3, 0.0),
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip: float = 0.2,
        epochs: int = 5,
        minibatches: int = 16,
        entropy: float | Schedule = 0.0,
        critic: float = 0.5,
        max_grad_norm: float = 0.5,
        compile: bool | Literal["auto"] = "auto",
        anchor: Anchor | None = None,
        auxiliary: Sequence[Extension] = (),
        seed: int = 0,
    ) -> None:
        check_range(0, alpha=alpha)
        self.alpha, self.imitation = alpha, KickstartLoss(guide=guide)
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
            clip=clip,
            epochs=epochs,
            minibatches=minibatches,
            entropy=entropy,
            critic=critic,
            max_grad_norm=max_grad_norm,
            compile=compile,
            anchor=anchor,
            auxiliary=auxiliary,
            seed=seed,
        )
        self.keys += self.imitation.keys
        self.minibatch_keys += self.imitation.keys

    def build_policy(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        network: Mlp,
        make_actor: Callable[..., ProbabilisticTensorDictSequential],
    ) -> ProbabilisticTensorDictSequential:
        """Return the policy, and make the auxiliary one."""
        self.imitator = networks.actor(env, in_keys, network, inputs=self.inputs)
        return super().build_policy(env, in_keys, network, make_actor)

    def parameter_groups(self) -> list[list[nn.Parameter]]:
        """Return the parameters that the optimiser updates."""
        return [*super().parameter_groups(), [*self.imitator.parameters()]]

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the losses of `PPO` with another `loss_objective`, `loss_imitation`, and `weight`.

        `loss_objective` is the weighted sum of both losses, `weight` the mean of w, and
        `loss_imitation` the loss of the auxiliary policy.
        """
        losses = super().losses(minibatch)
        predicted = self.imitation.each(self.imitator, minibatch)
        weight = (-self.alpha * self.distance(minibatch, predicted.detach())).exp()
        log_ratio = (
            self.head.get_dist(minibatch).log_prob(minibatch["action"])
            - minibatch["action_log_prob"]
        )
        advantage = standardise(minibatch["advantage"]).squeeze(-1)
        clipped = log_ratio.clamp(*self.loss._clip_bounds)
        gain = torch.minimum(log_ratio.exp() * advantage, clipped.exp() * advantage)
        mixed = weight * self.imitation.each(self.head, minibatch) - (1 - weight) * gain
        losses["loss_imitation"] = predicted.mean()
        losses["loss_objective"] = mixed.mean() + losses["loss_imitation"]
        losses["weight"] = weight.mean()
        return losses

    @torch.no_grad()
    def distance(self, minibatch: TensorDictBase, surprise: Tensor) -> Tensor:
        """Return D [N]; `surprise` is -log pi_aux(g | s)."""
        if not minibatch["action"].is_floating_point():
            return surprise
        mode = self.imitator.get_dist(minibatch.select(*self.imitator.in_keys)).deterministic_sample
        difference: Tensor = minibatch["guide_action"][..., self.imitation.guide, :] - mode
        return difference.abs().flatten(1).amax(1)
