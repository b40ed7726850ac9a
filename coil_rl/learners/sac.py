"""Soft actor-critic with a learned temperature (Haarnoja et al. 2018).

Two critics say what return an action is worth, and the return counts surprise too: each step pays r - alpha log pi(a).
Steps of the past are drawn at random, and both critics are moved towards y = r + gamma * (min Q'(s', b) - alpha log
pi(b | s')) with b drawn from the policy, or r alone where the episode terminated; Q' are copies of the critics that
follow them slowly. The policy is moved to where min Q(s, a) - alpha log pi(a | s) is high, and alpha so that the
policy's entropy stays near a target.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import SACLoss, SoftUpdate

from coil_rl import networks
from coil_rl.learners.replay import Replay
from coil_rl.schedules import Schedule, schedule


class SAC:
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
        target_entropy: of the policy, before it is given a unit; None is minus the length of the action.
        tau: share of the way to the critics that their slow copies go after each minibatch.
        max_grad_norm: gradients are scaled down to this norm.
        capacity: steps that are kept.
        batch_size: steps of a minibatch.
        ratio: how often a step is learned from, on average.
        starts: steps before it begins to learn.
        seed: of the draws of minibatches.

    Raises:
        ValueError: for a value outside its range, an env with choices, or as `Replay`.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=64)
        >>> sac = SAC(env, starts=256)
        >>> metrics = sac.update(Rollout(env, sac.policy, steps=8, keys=sac.keys).collect())
    """

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
        self.learning_rate = schedule(learning_rate)
        for name, number, highest in (
            ("gamma", gamma, 1), ("tau", tau, 1), ("action_gain", action_gain, math.inf),
            ("learning_rate", self.learning_rate(0), math.inf),
        ):  # fmt: skip
            if not 0 <= number <= highest:
                raise ValueError(f"{name}={number} must be at least 0 and at most {highest}")
        if min(hidden, default=1) < 1:
            raise ValueError(f"hidden={min(hidden)} must be at least 1")
        for name, number in {
            "action_scale": action_scale, "temperature": temperature, "max_grad_norm": max_grad_norm,
        }.items():  # fmt: skip
            if not 0 < number < math.inf:
                raise ValueError(f"{name}={number} must be a finite number of more than 0")
        spec = env.action_spec
        if not spec.dtype.is_floating_point:
            raise ValueError(
                "SAC acts by numbers, but this env takes one of a few choices; "
                "give action=continuous, or take a learner that chooses, such as DQN"
            )
        self.replay = Replay(
            env, in_keys, capacity=capacity, batch_size=batch_size, ratio=ratio, starts=starts, seed=seed
        )
        self.keys = self.replay.keys
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
        self.loss = SACLoss(
            self.policy,
            critics,
            alpha_init=temperature,
            target_entropy=float(-size if target_entropy is None else target_entropy),
            loss_function="l2",
        )
        self.loss.target_entropy  # noqa: B018  only once asked for it is part of the state
        self.loss.make_value_estimator(gamma=gamma)
        self.target = SoftUpdate(self.loss, tau=tau)
        self.max_grad_norm = max_grad_norm
        self.parameters = list(self.loss.parameters())
        self.optimiser = torch.optim.Adam(self.parameters, lr=self.learning_rate(0), fused=True)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Keep the steps of a batch, and learn from steps of the past.

        Args:
            batch: [*B, T] with `keys`. A truncated episode counts as going on.
            progress: share of the run that is over, for the schedules.

        Returns:
            Means over the minibatches of the losses of the actor, the critics (`qvalue`) and the temperature (`alpha`),
            of the temperature itself and of the policy's entropy, 0 before it begins to learn; how many `minibatches`
            there were; the steps that are `kept`.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate(progress)
        self.replay.add(batch)
        reports = []
        for minibatch in self.replay.draws():
            losses = self.loss(minibatch)
            self.optimiser.zero_grad()
            (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
            torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
            self.optimiser.step()
            self.target.step()
            reports.append(losses.detach())
        means = {
            name: float(torch.stack([report[name] for report in reports]).mean()) if reports else 0.0
            for name in ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")
        }
        return means | {
            "minibatches": float(len(reports)),
            "kept": float(len(self.replay)),
            "learning_rate": self.learning_rate(progress),
        }

    def state_dict(self) -> dict[str, Any]:
        """Everything an update depends on besides the batch; the policy is part of the loss."""
        return {
            "loss": self.loss.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "replay": self.replay.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""
        self.loss.load_state_dict(state["loss"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.replay.load_state_dict(state["replay"])
