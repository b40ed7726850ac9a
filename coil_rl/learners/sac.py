"""Soft actor-critic with a learned temperature (Haarnoja et al. 2018).

Two critics estimate the return of an action, to which each step adds an entropy reward: r - alpha log pi(a). For stored
steps sampled at random, both are moved towards y = r + gamma * (min Q'(s', b) - alpha log pi(b | s')) with b drawn from
the policy, or y = r where the episode terminated. Q' are target networks that follow the critics slowly. The policy
maximises min Q(s, a) - alpha log pi(a | s), and alpha is adjusted to keep the entropy of the policy near a target.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torchrl.envs import EnvBase
from torchrl.objectives import SACLoss

from coil_rl.envs.limits import check_range
from coil_rl.learners import networks
from coil_rl.learners.encoders import Mlp, entry_keys, without_memory
from coil_rl.learners.off_policy import OffPolicy


class SAC(OffPolicy):
    """The SAC learner.

    COIL is SAC with `guide_action` among `in_keys`.

    Args:
        env: the env, with continuous actions.
        in_keys: entries that policy and critics observe.
        hidden: widths of the hidden layers of all networks, without `network`.
        network: architecture of all networks; None: `Mlp(hidden)`.
        action_scale: initial standard deviation of the policy, before squashing.
        action_gain: initial scale of the last weights of the policy; with 0 its mean is 0.
        temperature: initial alpha.
        target_entropy: of the policy, for actions in the unit of the env; None: minus the number of its dimensions.
        tau: step of the target networks towards the critics after each minibatch, as a fraction.
        ratio: how often a step is sampled, on average.
        options: as for `OffPolicy`. For returns in the hundreds, as of a pendulum, use a large `max_grad_norm`:
            otherwise the gradients of the critics dominate those of the policy.

    Raises:
        ValueError: for a value out of range, an env with discrete actions, or as `OffPolicy`.
    """

    minimised = ("loss_actor", "loss_qvalue", "loss_alpha")
    reported = (*minimised, "alpha", "entropy")

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
        tau: float = 0.02,
        ratio: float = 8.0,
        **options: Any,
    ) -> None:
        check_range(0, action_gain=action_gain)
        check_range(0, above=True, action_scale=action_scale, temperature=temperature)
        spec = env.action_spec
        if not spec.dtype.is_floating_point:
            raise ValueError(
                "SAC needs continuous actions, but this env has discrete ones; "
                "use action=continuous, or a learner for discrete actions, such as DQN"
            )
        in_keys, network = entry_keys(in_keys), without_memory(network or Mlp(hidden), "SAC")
        super().__init__(env, in_keys, tau=tau, ratio=ratio, **options)
        self.policy = networks.actor(
            env, in_keys, network, action_scale, action_gain, state_dependent_scale=True, normaliser=self.normaliser
        )
        # Minibatches are normalised once, for all networks.
        actor = self.policy if self.normaliser is None else ProbabilisticTensorDictSequential(*self.policy.module[1:])
        loss = SACLoss(
            actor,
            [networks.action_critic(env, in_keys, network, self.normaliser) for _ in range(2)],
            alpha_init=temperature,
            target_entropy=float(-networks.action_shape(env).numel() if target_entropy is None else target_entropy),
            loss_function="l2",
        )
        loss.target_entropy  # noqa: B018  becomes part of the state at the first access
        self.set_loss(loss)
