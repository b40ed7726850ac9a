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

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import REDQLoss, SACLoss

from coil_rl.envs.limits import check_range
from coil_rl.learners import networks
from coil_rl.learners.encoders import Mlp, without_memory
from coil_rl.learners.kickstart import KickstartLoss
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.transforms.action_space import nested_key


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
        auxiliary: additional losses of the policy.
        tau, ratio, options: as for `OffPolicy`. For returns in the hundreds, as of a pendulum, use
            a large `max_grad_norm`: otherwise the gradients of the critics dominate those of the
            policy.
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
        action_scale: float = 0.5,
        action_gain: float = 0.01,
        temperature: float = 0.2,
        target_entropy: float | None = None,
        critics: int = 2,
        target_critics: int | None = None,
        critic_layer_norm: bool = False,
        uncertainty: bool = False,
        auxiliary: Sequence[KickstartLoss] = (),
        tau: float = 0.02,
        ratio: float = 8.0,
        **options: Any,
    ) -> None:
        check_range(2, 1_000, critics=critics)
        if target_critics is not None and not 1 <= target_critics < critics:
            raise ValueError(
                f"target_critics={target_critics} must be at least 1 and less than critics={critics}"
            )
        check_range(0, action_gain=action_gain)
        check_range(0, above=True, action_scale=action_scale, temperature=temperature)
        spec = env.action_spec
        if not spec.dtype.is_floating_point:
            remedy = "use action=continuous, or a learner for discrete actions, such as DQN"
            raise ValueError(
                f"SAC needs continuous actions, but this env has discrete ones; {remedy}"
            )
        in_keys, network = (
            list(map(nested_key, in_keys)),
            without_memory(network or Mlp(hidden), "SAC"),
        )
        super().__init__(env, in_keys, tau=tau, ratio=ratio, **options)
        self.action_scale, self.action_gain = action_scale, action_gain
        # Minibatches are normalised once, for all networks.
        self.actor = self.build_actor(env, in_keys, network)
        before = [] if self.normaliser is None else [self.normaliser]
        self.policy = ProbabilisticTensorDictSequential(*before, *self.actor.module)
        architectures = [
            replace(network, layer_norm=True) if critic_layer_norm else network
        ] * critics
        arguments = {
            "actor_network": self.actor,
            "qvalue_network": [
                networks.action_critic(env, in_keys, each, self.normaliser)
                for each in architectures
            ],
            "num_qvalue_nets": critics,
            "alpha_init": temperature,
            "target_entropy": float(
                -networks.action_shape(env).numel() if target_entropy is None else target_entropy
            ),
            "loss_function": "l2",
        }
        if target_critics is None:
            loss = self.build_loss(env, in_keys, network, **arguments)
        else:
            # Its own bounds of alpha are for rewards of about 1.
            loss = REDQLoss(
                **arguments, sub_sample_len=target_critics, min_alpha=1e-8, max_alpha=1e8
            )
        loss.target_entropy  # noqa: B018  becomes part of the state at the first access
        self.set_loss(loss)
        self.critics = Critics(loss)
        self.writes_uncertainty = uncertainty
        if uncertainty:
            self.policy = TensorDictSequential(self.policy, self.critics)
        self.auxiliary = list(auxiliary)
        for each in self.auxiliary:
            each.critics = self.critics
            self.also_store(*each.keys)
            self.reported = (*self.reported, f"loss_{each.name}")

    def build_actor(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp
    ) -> ProbabilisticTensorDictSequential:
        """Return a policy that reads entries that have been normalised already."""
        policy = networks.actor(
            env,
            in_keys,
            network,
            self.action_scale,
            self.action_gain,
            state_dependent_scale=True,
            normaliser=self.normaliser,
            anchor=self.anchor,
        )
        return (
            policy
            if self.normaliser is None
            else ProbabilisticTensorDictSequential(*policy.module[1:])
        )

    def build_loss(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp, **arguments: Any
    ) -> SACLoss:
        """Return the loss for networks that observe `in_keys`; `arguments` are those of TorchRL's."""
        return SACLoss(**arguments)

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the losses of a minibatch [N] and other values, scalars."""
        losses = super().losses(minibatch)
        for each in self.auxiliary:
            losses[f"loss_{each.name}"] = each(self.actor, minibatch)
        return losses

    def loss_weights(self, progress: float) -> dict[str, float]:
        """Return the weights of the losses in the sum that an update minimises."""
        learns = float(self.anchor is None or not self.anchor.waits(progress))
        weights = super().loss_weights(progress) | {"loss_actor": learns}
        return weights | {
            f"loss_{each.name}": learns * each.coefficient_at(progress) for each in self.auxiliary
        }

    @torch.no_grad()
    def describe(self, minibatch: TensorDictBase | None) -> dict[str, float]:
        """Return the mean uncertainty about the actions of the last minibatch, 0 before learning starts."""
        if not self.writes_uncertainty:
            return {}
        return {
            "uncertainty": 0.0
            if minibatch is None
            else float(self.critics.values(minibatch).std(0).mean())
        }


class Critics(TensorDictModuleBase):
    """The critics of a loss of TorchRL, all at once; they read entries that have been normalised already.

    As a module it writes their uncertainty: the standard deviation of the values of an action, in
    the unit of the return, as `("next", "uncertainty")` [*B, 1]. The `weights` are perhaps those of
    the target networks; None: those that learn.
    """

    def __init__(self, loss: SACLoss | REDQLoss, weights: TensorDictBase | None = None) -> None:
        self._network = (
            loss.qvalue_network,
        )  # without weights; a tuple, so that it is no submodule
        self.in_keys: list[NestedKey] = list(loss.qvalue_network.in_keys)
        self.out_keys: list[NestedKey] = [("next", "uncertainty")]
        super().__init__()
        self.weights = loss.qvalue_network_params if weights is None else weights

    def values(self, tensordict: TensorDictBase) -> Tensor:
        """Return the values of the action, [critics, *B]."""
        (network,) = self._network
        data = tensordict.select(*network.in_keys)

        def one(weights: TensorDictBase) -> Tensor:
            with weights.to_module(network):
                value: Tensor = network(data.copy())["state_action_value"]
            return value

        return torch.vmap(one)(self.weights).squeeze(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the uncertainty for the next step of the env."""
        return tensordict.set(("next", "uncertainty"), self.values(tensordict).std(0).unsqueeze(-1))
