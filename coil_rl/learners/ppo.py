"""Proximal policy optimisation with clipped ratios (paper equation 92; Schulman et al. 2017).

A batch of rollouts gets advantages from a critic (generalised advantage estimation); the policy then takes several
passes over the batch in minibatches, held near the policy that collected it by clipping the probability ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss

from coil_rl.learners.actor_critic import ActorCritic
from coil_rl.learners.advantages import Advantages
from coil_rl.learners.limits import check_numbers
from coil_rl.schedules import Schedule, schedule


class PPO(ActorCritic):
    """The PPO learner.

    Args:
        env: for the shapes of what is observed and done.
        in_keys: what policy and critic observe. COIL is PPO with `guide_action` among them.
        gamma: discount.
        gae_lambda: lambda of generalised advantage estimation.
        clip: how far the probability ratio may move the objective.
        epochs: passes over each batch.
        minibatches: parts of each pass.
        entropy: weight of the entropy bonus, a number or a schedule.
        critic: weight of the critic's loss.
        compile: the loss by `torch.compile`, which takes some ten seconds and pays in long runs. The numbers then
            differ in their last digits.
        networks_and_optimiser: everything else as for `ActorCritic`.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.train.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=64)
        >>> ppo = PPO(env)
        >>> metrics = ppo.update(Rollout(env, ppo.policy, steps=32).collect())
    """

    kind = "agent"

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip: float = 0.2,
        epochs: int = 10,
        minibatches: int = 16,
        entropy: float | Schedule = 0.0,
        critic: float = 0.5,
        compile: bool = False,
        **networks_and_optimiser: Any,
    ) -> None:
        super().__init__(env, in_keys, minibatches=minibatches, **networks_and_optimiser)
        self.entropy = schedule(entropy)
        check_numbers(1, epochs=epochs)
        check_numbers(0, critic=critic, entropy=self.entropy(0))
        check_numbers(0, above=True, clip=clip)
        self.epochs = epochs
        self.advantage = Advantages(self.critic, gamma, gae_lambda)
        self.loss = ClipPPOLoss(
            self.policy,
            self.critic,
            clip_epsilon=clip,
            entropy_bonus=self.entropy(0) > 0,
            entropy_coeff=self.entropy(0),
            critic_coeff=critic,
            loss_critic_type="l2",
            normalize_advantage=True,
            functional=False,
        )
        if compile:
            self.losses = torch.compile(self.loss.__call__)  # type: ignore[method-assign]
