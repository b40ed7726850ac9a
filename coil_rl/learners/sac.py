"""Soft actor-critic with a learned temperature (Haarnoja et al. 2018).

Two critics estimate the return of an action, to which each step adds an entropy reward: r - alpha
log pi(a). For stored steps sampled at random, both are moved towards y = r + gamma * (min Q'(s', b)
- alpha log pi(b | s')) with b drawn from the policy, or y = r where the episode terminated. Q' are
target networks that follow the critics slowly. The policy maximises min Q(s, a) - alpha log pi(a |
s), and alpha is adjusted to keep the entropy of the policy near a target.

With many critics, y has the minimum over a random few of them, and the policy maximises their mean
(REDQ, Chen et al. 2021); RLPD is this with layer normalisation and a share of prior steps in each
minibatch (Ball et al. 2023).
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any, Unpack

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule, REDQLoss, SACLoss

from coil_rl.learners import networks
from coil_rl.learners.critics import Critics
from coil_rl.learners.encoders import Mlp, without_memory
from coil_rl.learners.extension import Extension
from coil_rl.learners.kickstart import KickstartLoss
from coil_rl.learners.off_policy import OffPolicy, Ratio, ReplaySettings
from coil_rl.learners.policy import Policy
from coil_rl.ranges import Interval, NonNegative, Positive, Share, checked
from coil_rl.transforms.action_space import ChoicesError, nested_key


class SACSettings(ReplaySettings, total=False):
    """All settings of `SAC`."""

    hidden: Sequence[int]
    network: Mlp | None
    action_scale: Positive
    action_gain: NonNegative
    temperature: Positive
    target_entropy: float | None
    critics: Annotated[int, Interval(ge=2, le=1_000)]
    target_critics: int | None
    critic_layer_norm: bool
    uncertainty: bool
    auxiliary: Sequence[Extension]
    tau: Share
    ratio: Ratio


@checked
class SAC(OffPolicy):
    """The SAC learner.

    COIL is SAC with `guide_action` among `in_keys`. A value out of range, an env with discrete
    actions, and what `OffPolicy` refuses are a `ValueError`.

    Args:
        env: the env, with continuous actions.
        in_keys: entries that policy and critics observe.
        hidden: widths of the hidden layers of all networks, without `network`.
        network: architecture of all networks; None: `Mlp(hidden)`.
        action_scale: initial standard deviation of the policy, before squashing.
        action_gain: initial scale of the last weights of the policy; with 0 its mean is 0.
        temperature: initial alpha.
        target_entropy: of the policy, for actions in the unit of the env; None: minus the number of
            its dimensions.
        critics: number of critics.
        target_critics: number of critics, drawn for each minibatch, whose minimum is y, with the
            mean in place of the minimum for the policy; None: the minimum of all for both.
        critic_layer_norm: whether the critics normalise their layers, which bounds the values of
            actions never tried.
        uncertainty: whether the policy writes that of the critics, see `Critics`, for
            `AdaptiveMixedAction`.
        auxiliary: extensions, such as losses of the policy (`KickstartLoss`).
        settings: further ones of `OffPolicy`. Take a large `max_grad_norm` for returns in the
            hundreds, as of a pendulum: otherwise the gradients of the critics dominate those of
            the policy.
    """

    minimised = ("loss_actor", "loss_qvalue", "loss_alpha")
    reported: tuple[str, ...] = (*minimised, "alpha", "entropy")

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        network: Mlp | None = None,
        action_scale: Positive = 0.5,
        action_gain: NonNegative = 0.01,
        temperature: Positive = 0.2,
        target_entropy: float | None = None,
        critics: Annotated[int, Interval(ge=2, le=1_000)] = 2,
        target_critics: int | None = None,
        critic_layer_norm: bool = False,
        uncertainty: bool = False,
        auxiliary: Sequence[Extension] = (),
        tau: Share = 0.02,
        ratio: Ratio = 8.0,
        **settings: Unpack[ReplaySettings],
    ) -> None:
        if target_critics is not None and not 1 <= target_critics < critics:
            raise ValueError(
                f"target_critics={target_critics} must be at least 1 and less than "
                f"critics={critics}"
            )
        if not env.action_spec.dtype.is_floating_point:
            raise ChoicesError(
                "SAC needs continuous actions, but this env has discrete ones; use "
                "action=continuous, or a learner for discrete actions, such as DQN"
            )
        in_keys = [nested_key(key) for key in in_keys]
        network = without_memory(network or Mlp(hidden), "SAC")
        super().__init__(env, in_keys, tau=tau, ratio=ratio, **settings)
        self.action_scale, self.action_gain = action_scale, action_gain
        self.actor = self.build_actor(env, in_keys, network)
        if target_entropy is None:
            target_entropy = -networks.action_shape(env).numel()
        critic = replace(network, layer_norm=True) if critic_layer_norm else network
        arguments = {
            "actor_network": self.actor,
            "qvalue_network": [
                networks.action_critic(env, in_keys, critic, self.inputs, self.action_key)
                for _ in range(critics)
            ],
            "num_qvalue_nets": critics,
            "alpha_init": temperature,
            "target_entropy": float(target_entropy),
            "loss_function": "l2",
        }
        self.set_loss(self.build_loss(env, in_keys, network, target_critics, arguments))
        self.critics, self.writes_uncertainty = Critics(self.loss), uncertainty
        self.policy = self.build_policy()
        self._extend(auxiliary)

    def build_actor(self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp) -> Policy:
        """Return a policy that reads entries that have been normalised already.

        Minibatches are normalised once, for all networks.
        """
        policy = networks.actor(
            env,
            in_keys,
            network,
            self.action_scale,
            self.action_gain,
            state_dependent_scale=True,
            clip=False,  # where a bound is missing the critics learn of the sample itself
            inputs=self.inputs,
            anchor=self.anchor,
        )
        if self.inputs is None:
            return policy
        return Policy(*policy.module[1:])

    def build_loss(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        network: Mlp,
        target_critics: int | None,
        arguments: dict[str, Any],
    ) -> LossModule:
        """Return TorchRL's loss, given its `arguments`; the networks observe `in_keys`."""
        if target_critics is None:
            loss = SACLoss(**arguments)
        else:
            # Its own bounds of alpha are for rewards of about 1.
            bounds = {"min_alpha": 1e-8, "max_alpha": 1e8}
            loss = REDQLoss(**arguments, sub_sample_len=target_critics, **bounds)
        loss.target_entropy  # noqa: B018  becomes part of the state at the first access
        return loss

    def build_policy(self) -> TensorDictSequential:
        """Return the policy that collects the batches."""
        before = [] if self.inputs is None else [self.inputs]
        policy = Policy(*before, *self.actor.module)
        return TensorDictSequential(policy, self.critics) if self.writes_uncertainty else policy

    def _extend(self, auxiliary: Sequence[Extension]) -> None:
        for each in auxiliary:
            if isinstance(each, KickstartLoss):
                each.critics = self.critics
        self.extend(auxiliary)
        self.reported = (*self.reported, *self.extensions.weights({}, 0.0))

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the losses of a minibatch [N] and other values, scalars."""
        losses = super().losses(minibatch)
        for name, loss in self.extensions.losses(self.actor, minibatch).items():
            losses[name] = loss
        return losses

    @torch.no_grad()
    def describe(self, minibatch: TensorDictBase | None) -> dict[str, float]:
        """Return the mean uncertainty about the last minibatch, NaN without one."""
        if not self.writes_uncertainty:
            return {}
        if minibatch is None:
            return {"uncertainty": math.nan}
        return {"uncertainty": float(self.critics.values(minibatch).std(0).mean())}
