"""Advantage actor-critic (paper equation 76; Mnih et al. 2016), in its synchronous form.

An action becomes more likely by as much as it was better than what the critic expected of its state. Each batch is
learned from once, as its actions tell of the policy that chose them and of no later one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl.envs import EnvBase
from torchrl.objectives import A2CLoss

from coil_rl.learners.actor_critic import ActorCritic
from coil_rl.learners.advantages import Advantages
from coil_rl.learners.limits import check_numbers
from coil_rl.schedules import Schedule, schedule


class A2C(ActorCritic):
    """The A2C learner: minimises - mean(log pi(a | s) A(s, a)).

    Args:
        env: for the shapes of what is observed and done.
        in_keys: what policy and critic observe.
        gamma: discount.
        gae_lambda: lambda of generalised advantage estimation.
        standardise: the advantages of a minibatch, so that the weights of other losses mean the same for any reward.
        entropy: weight of the entropy bonus, a number or a schedule.
        critic: weight of the critic's loss.
        networks_and_optimiser: everything else as for `ActorCritic`.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.train.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=64)
        >>> a2c = A2C(env)
        >>> metrics = a2c.update(Rollout(env, a2c.policy, steps=8).collect())
    """

    kind = "agent"

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        standardise: bool = True,
        entropy: float | Schedule = 0.0,
        critic: float = 0.5,
        **networks_and_optimiser: Any,
    ) -> None:
        super().__init__(env, in_keys, **networks_and_optimiser)
        self.entropy = schedule(entropy)
        check_numbers(0, critic=critic, entropy=self.entropy(0))
        self.standardise = standardise
        self.advantage = Advantages(self.critic, gamma, gae_lambda)
        self.loss = A2CLoss(
            self.policy,
            self.critic,
            entropy_bonus=self.entropy(0) > 0,
            entropy_coeff=self.entropy(0),
            critic_coeff=critic,
            loss_critic_type="l2",
            functional=False,
        )
