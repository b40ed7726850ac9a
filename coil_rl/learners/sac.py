"""Soft actor-critic with a learned temperature (Haarnoja et al. 2018).

Two critics estimate the return of an action, to which each step adds an entropy reward: r - alpha
log pi(a). For stored steps sampled at random, both are moved towards

    y = r + gamma (min Q'(s', b) - alpha log pi(b | s')),  b from pi(. | s'),

or y = r where the episode terminated. Q' are target networks that follow the critics slowly. The
policy maximises min Q(s, a) - alpha log pi(a | s), and alpha is adjusted to keep the entropy of the
policy near a target.

With many critics, y has the minimum over a random few of them, and the policy maximises their mean
(REDQ, Chen et al. 2021). DroQ has dropout and normalised layers in two critics (Hiraoka et al.
2022). RLPD is this with a share of prior steps in each minibatch (Ball et al. 2023).
"""

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar, Unpack

import torch
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import EnvBase

from coil_rl.learners import networks
from coil_rl.learners.critics import Critics, Norm
from coil_rl.learners.encoders import Mlp
from coil_rl.learners.extension import Extension
from coil_rl.learners.gradient import Weights
from coil_rl.learners.off_policy import OffPolicy, ReplaySettings, UpdatesPerStep
from coil_rl.learners.policy import ByKey, Entries, GaussianHead, Policy, next_of
from coil_rl.learners.rewards import discounted
from coil_rl.ranges import Interval, NonNegative, Positive, Share, checked
from coil_rl.schedules import Schedule


class CrossQSettings(ReplaySettings, total=False):
    """Settings of `SAC` that `CrossQ` has too."""

    hidden: Sequence[int]
    network: Mlp | None
    action_scale: Positive
    action_gain: NonNegative
    temperature: Positive
    target_entropy: float | None
    critics: Annotated[int, Interval(ge=2, le=1_000)]
    target_critics: int | None
    dropout: Share
    uncertainty: bool
    updates_per_step: UpdatesPerStep
    learning_rate: NonNegative | Schedule
    max_grad_norm: Positive | None
    auxiliary: Sequence[Extension]


class SACSettings(CrossQSettings, total=False):
    """All settings of `SAC`."""

    critic_layer_norm: bool
    tau: Share


@checked
class SAC(OffPolicy):
    """The SAC learner.

    COIL is SAC with `guide_action` among `in_keys`. A value out of range, an env with discrete
    actions, and what `OffPolicy` refuses are a `ValueError`.

    Args:
        env: the env, with continuous actions.
        in_keys: entries that policy and critics observe.
        hidden: widths of the hidden layers of all networks, without `network`.
        network: architecture of all networks; None: `Mlp(hidden, "relu")`.
        action_scale: initial standard deviation of the policy, before squashing. With 1 the first
            actions are almost uniform between the bounds.
        action_gain: initial scale of the last weights of the policy; with 0 its mean is 0.
        temperature: initial alpha.
        target_entropy: of the policy, for actions in the unit of the env; None: minus the number of
            its dimensions.
        critics: number of critics.
        target_critics: number of critics, drawn for each minibatch, whose minimum is y, with the
            mean in place of the minimum for the policy; None: the minimum of all for both.
        critic_layer_norm: whether the critics normalise their layers, which bounds the values of
            actions never tried.
        dropout: share of the numbers of a hidden layer of the critics that are left out at random.
        uncertainty: whether the policy writes that of the critics, see `Critics`, for
            `AdaptiveMixedAction`.
        settings: further ones of `OffPolicy`.
    """

    parts = ("critics", "temperature", *OffPolicy.parts)
    minimised = ("loss_actor", "loss_qvalue", "loss_alpha")
    reported: tuple[str, ...] = (*minimised, "alpha", "entropy", "value")
    betas = (0.9, 0.999)  # of Adam
    values_of_a_critic = 1
    with_target: ClassVar[bool] = True
    norm: ClassVar[Norm] = "none"  # of the critics, without `critic_layer_norm`
    gain: ClassVar[float] = 1.0  # of the critics

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        network: Mlp | None = None,
        action_scale: Positive = 1.0,
        action_gain: NonNegative = 0.01,
        temperature: Positive = 0.1,
        target_entropy: float | None = None,
        critics: Annotated[int, Interval(ge=2, le=1_000)] = 2,
        target_critics: int | None = None,
        critic_layer_norm: bool = False,
        dropout: Share = 0.0,
        uncertainty: bool = False,
        auxiliary: Sequence[Extension] = (),
        tau: Share = 0.02,
        updates_per_step: UpdatesPerStep = 1.0,
        learning_rate: NonNegative | Schedule = 1e-3,
        max_grad_norm: Positive | None = None,
        **settings: Unpack[ReplaySettings],
    ) -> None:
        if target_critics is not None and not 1 <= target_critics < critics:
            raise ValueError(
                f"target_critics={target_critics} must be at least 1 and less than "
                f"critics={critics}"
            )
        if not env.action_spec.dtype.is_floating_point:
            raise ValueError(
                f"{type(self).__name__} needs continuous actions, but this env has discrete ones; "
                "use action=continuous, or learner=ppo with method=coil_anchored, or learner=dqn"
            )
        super().__init__(
            env,
            in_keys,
            network or Mlp(hidden, "relu"),
            tau=tau,
            updates_per_step=updates_per_step,
            learning_rate=learning_rate,
            max_grad_norm=max_grad_norm,
            auxiliary=auxiliary,
            **settings,
        )
        self.action_scale, self.action_gain = action_scale, action_gain
        self.actor = self.build_actor(env, self.in_keys, self.network)
        self.critics = Critics(
            env,
            self.in_keys,
            self.network,
            critics,
            outputs=self.values_of_a_critic,
            norm="layer" if critic_layer_norm else self.norm,
            dropout=dropout,
            gain=self.gain,
            inputs=self.inputs,
        )
        self.of_critics = Weights(self.critics)
        if self.with_target:
            self.follow(self.critics, self.of_critics)
        for each in auxiliary:
            each.meet(env, self.actor, self.critics)
        log_alpha = torch.tensor(math.log(temperature), device=self.device)
        self.temperature = nn.ParameterDict({"log_alpha": log_alpha})
        size = networks.action_shape(env).numel()
        entropy = -float(size) if target_entropy is None else target_entropy
        self.target_entropy = torch.tensor(entropy, device=self.device)
        self.target_critics, self.writes_uncertainty = target_critics, uncertainty
        self.policy = self.build_policy()
        self.of_actor = Weights(self.actor)
        learned = [self.of_actor, self.of_critics, *self.further_weights()]
        self.set_update(
            [*(each.vector for each in learned), self.temperature["log_alpha"]],
            [self.target_entropy, *self.policy.buffers(), *self.critics.buffers()],
            betas=self.betas,
        )

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
            head=GaussianHead,
            clip=False,  # where a bound is missing the critics learn of the sample itself
            inputs=self.inputs,
            anchor=self.anchor,
        )
        return policy if self.inputs is None else Policy(*policy.module[1:])

    def build_policy(self) -> TensorDictModuleBase:
        """Return the policy that collects the batches."""
        before = [] if self.inputs is None else [self.inputs]
        policy = Policy(*before, *self.actor.module)
        return ByKey(policy, self.critics) if self.writes_uncertainty else policy

    def further_weights(self) -> list[Weights]:
        """Return the weights that are learned besides those of policy and critics."""
        return []

    def losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the losses of a minibatch [N] by name, and other values, scalars."""
        with self.of_actor.used():
            with self.of_critics.used():
                losses = self.critic_losses(minibatch)
            with self.of_critics.used(fixed=True):
                losses |= self.actor_losses(minibatch)
                losses |= self.extensions.losses(self.actor, minibatch)
        return losses

    @property
    def alpha(self) -> Tensor:
        """The weight of the entropy, a scalar without gradient."""
        return self.temperature["log_alpha"].detach().exp()

    def acted(self, states: Entries) -> tuple[Entries, Tensor]:
        """Return states [N] with a random action of the policy, and its log-probability [N]."""
        entries, sample = states.copy(), self.actor.module[-1]
        drawn, log_prob = self.actor.density(entries).draw()
        entries.set(sample.sample_key, drawn)
        sample.write_action(entries)
        return entries, log_prob

    def critic_losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the loss of all critics."""
        with torch.no_grad(), self.of_target.used():
            after, log_prob = self.acted(next_of(minibatch))
            target = self.returns(minibatch, self.target.outputs(after, train=True), log_prob)
        return self.distances(self.critics.outputs(minibatch, train=True), target)

    def returns(self, minibatch: Entries, outputs: Tensor, log_prob: Tensor) -> Tensor:
        """Return y of a minibatch, [N, n].

        Args:
            outputs: of the critics for the next state and an action of the policy, [critics, N, n].
            log_prob: of this action, [N].
        """
        value = self.next_values(outputs) - (self.alpha * log_prob).unsqueeze(-1)
        reward = minibatch["next", "reward"].to(value.dtype)
        return reward + discounted(minibatch, self.gamma, value)

    def next_values(self, outputs: Tensor) -> Tensor:
        """Return the values of the next state, [N, n], from those of all critics."""
        if self.target_critics is not None:
            drawn = torch.randperm(len(outputs), device=outputs.device)[: self.target_critics]
            outputs = outputs[drawn]
        return outputs.amin(0)

    def distances(self, outputs: Tensor, target: Tensor) -> dict[str, Tensor]:
        """Return the loss of all critics from what they give, [critics, N, n], and y."""
        return {
            "loss_qvalue": (outputs - target).square().sum(0).mean(),
            "value": outputs.detach().mean(),
        }

    def values(self, outputs: Tensor) -> Tensor:
        """Return the values of actions of the policy, [N], from those of all critics."""
        values = outputs.squeeze(-1)
        return values.amin(0) if self.target_critics is None else values.mean(0)

    def actor_losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the losses of policy and temperature."""
        states, log_prob = self.acted(minibatch)
        value = self.values(self.critics.outputs(states))
        log_alpha, entropy = self.temperature["log_alpha"], -log_prob.detach().mean()
        return {
            "loss_actor": (self.alpha * log_prob - value).mean(),
            "loss_alpha": log_alpha * (entropy - self.target_entropy),
            "alpha": self.alpha,
            "entropy": entropy,
        }

    @torch.no_grad()
    def describe(self, minibatch: Entries | None) -> dict[str, float]:
        """Return the mean uncertainty about the last minibatch, NaN without one."""
        if not self.writes_uncertainty:
            return {}
        if minibatch is None:
            return {"uncertainty": math.nan}
        return {"uncertainty": float(self.critics.values(minibatch).std(0).mean())}
