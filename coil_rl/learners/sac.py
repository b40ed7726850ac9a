"""Soft actor-critic with a learned temperature (Haarnoja et al. 2018).

Two critics say what return an action is worth, and the return counts surprise too: each step pays r - alpha log pi(a).
Steps of the past are drawn at random, and both critics are moved towards y = r + gamma * (min Q'(s', b) - alpha log
pi(b | s')) with b drawn from the policy, or r alone where the episode terminated; Q' are copies of the critics that
follow them slowly. The policy is moved to where min Q(s, a) - alpha log pi(a | s) is high, and alpha so that the
policy's entropy stays near a target.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchrl.envs import EnvBase
from torchrl.objectives import SACLoss

from coil_rl.learners import networks
from coil_rl.learners.limits import check_numbers
from coil_rl.learners.off_policy import OffPolicy
from coil_rl.schedules import Schedule


class SAC(OffPolicy):
    """The SAC learner: networks, replay, loss and optimiser.

    Args:
        env: for the shapes of what is observed and of the action, which is numbers.
        in_keys: what policy and critics observe. COIL is SAC with `guide_action` among them.
        hidden: widths of the hidden layers of all networks.
        action_scale: standard deviation of the policy at the start, before squashing.
        action_gain: size of the weights behind mean and spread of the policy at the start; with 0 the mean is 0.
        learning_rate: of Adam, a number or a schedule over the run.
        gamma: discount.
        temperature: alpha at the start, the price of being predictable.
        target_entropy: of the policy, its actions in the env's unit; None is minus the length of the action.
        tau: share of the way to the critics that their slow copies go after each minibatch.
        max_grad_norm: gradients are scaled down to this norm, those of all networks together. Where returns are in the
            hundreds, as of a pendulum, the critics' then drown the policy's; give a large one.
        capacity: steps that are kept.
        batch_size: steps of a minibatch.
        ratio: how often a step is learned from, on average.
        starts: steps before it begins to learn.
        seed: of the draws of minibatches.

    Raises:
        ValueError: for a value outside its range, an env with choices, or as `Replay`.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.train.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=64)
        >>> sac = SAC(env, starts=256)
        >>> metrics = sac.update(Rollout(env, sac.policy, steps=8, keys=sac.keys).collect())
    """

    kind = "agent"

    minimised = ("loss_actor", "loss_qvalue", "loss_alpha")
    reported = (*minimised, "alpha", "entropy")

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        action_scale: float = 0.5,
        action_gain: float = 0.01,
        learning_rate: float | Schedule = 1e-3,
        gamma: float = 0.99,
        temperature: float = 1.0,
        target_entropy: float | None = None,
        tau: float = 0.005,
        max_grad_norm: float = 10.0,
        capacity: int = 100_000,
        batch_size: int = 256,
        ratio: float = 16.0,
        starts: int = 1_000,
        seed: int = 0,
    ) -> None:
        check_numbers(1, hidden=min(hidden, default=1))
        check_numbers(0, action_gain=action_gain)
        check_numbers(0, above=True, action_scale=action_scale, temperature=temperature)
        spec = env.action_spec
        if not spec.dtype.is_floating_point:
            raise ValueError(
                "SAC acts by numbers, but this env takes one of a few choices; "
                "give action=continuous, or take a learner that chooses, such as DQN"
            )
        self.policy = networks.spread_actor(env, in_keys, hidden, action_scale, action_gain)
        size, judged = spec.shape[-1], [*in_keys, "action"]
        critics = [
            networks.Keyed(
                networks.Network(env, judged, hidden, 1, 1.0, {"action": torch.Size([size])}),
                judged,
                ["state_action_value"],
            )
            for _ in range(2)
        ]
        loss = SACLoss(
            self.policy,
            critics,
            alpha_init=temperature,
            target_entropy=float(-size if target_entropy is None else target_entropy),
            loss_function="l2",
        )
        loss.target_entropy  # noqa: B018  only once asked for it is part of the state
        super().__init__(
            env, in_keys, loss, learning_rate=learning_rate, gamma=gamma, tau=tau, max_grad_norm=max_grad_norm,
            capacity=capacity, batch_size=batch_size, ratio=ratio, starts=starts, seed=seed,
        )  # fmt: skip
