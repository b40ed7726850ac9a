"""Proximal policy optimisation with clipped ratios (paper equation 92; Schulman et al. 2017).

A batch of rollouts gets advantages from a critic (generalised advantage estimation); the policy then takes several
passes over the batch in minibatches, held near the policy that collected it by clipping the probability ratio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import nn
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss

from coil_rl import networks
from coil_rl.learners.advantages import Advantages
from coil_rl.learners.guide_loss import AuxiliaryLoss
from coil_rl.schedules import Schedule, schedule


class PPO:
    """The PPO learner: networks, loss and optimiser.

    Args:
        env: for the shapes of what is observed and done.
        in_keys: what policy and critic observe. COIL is PPO with `guide_action` among them.
        hidden: widths of the hidden layers of both networks.
        action_scale: standard deviation of the policy at the start.
        action_gain: size of the weights behind the mean of the policy at the start; with 0 the mean is 0 everywhere.
        learning_rate: of Adam, a number or a schedule over the run.
        gamma: discount.
        gae_lambda: lambda of generalised advantage estimation.
        clip: how far the probability ratio may move the objective.
        epochs: passes over each batch.
        minibatches: parts of each pass.
        entropy: weight of the entropy bonus, a number or a schedule.
        critic: weight of the critic's loss.
        max_grad_norm: gradients are scaled down to this norm.
        auxiliary: more losses of the policy.
        compile: the loss by `torch.compile`, which takes some ten seconds and pays in long runs. The numbers then
            differ in their last digits.
        seed: of the order of minibatches.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=64)
        >>> ppo = PPO(env)
        >>> metrics = ppo.update(Rollout(env, ppo.policy, steps=32).collect())
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        action_scale: float = 0.5,
        action_gain: float = 0.01,
        learning_rate: float | Schedule = 3e-4,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip: float = 0.2,
        epochs: int = 10,
        minibatches: int = 16,
        entropy: float | Schedule = 0.0,
        critic: float = 0.5,
        max_grad_norm: float = 0.5,
        auxiliary: Sequence[AuxiliaryLoss] = (),
        compile: bool = False,
        seed: int = 0,
    ) -> None:
        for name, value in {"hidden": min(hidden, default=1), "epochs": epochs, "minibatches": minibatches}.items():
            if value < 1:
                raise ValueError(f"{name}={value} must be at least 1")
        for name, number, low, high in (
            ("gamma", gamma, 0, 1), ("gae_lambda", gae_lambda, 0, 1), ("critic", critic, 0, math.inf),
            ("action_gain", action_gain, 0, math.inf), ("seed", seed, 0, 2**63 - 1),
        ):  # fmt: skip
            if not low <= number <= high:
                raise ValueError(f"{name}={number} must be at least {low} and at most {high}")
        for name, number in {"action_scale": action_scale, "clip": clip, "max_grad_norm": max_grad_norm}.items():
            if not 0 < number < math.inf:
                raise ValueError(f"{name}={number} must be a finite number of more than 0")
        self.policy = self.build_policy(env, in_keys, hidden, action_scale, action_gain)
        self.critic = networks.critic(env, in_keys, hidden)
        self.learning_rate, self.entropy = schedule(learning_rate), schedule(entropy)
        for name, number in {"learning_rate": self.learning_rate(0), "entropy": self.entropy(0)}.items():
            if not 0 <= number < math.inf:
                raise ValueError(f"{name}={number} must be a finite number of at least 0")
        self.epochs, self.minibatches, self.max_grad_norm = epochs, minibatches, max_grad_norm
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
        self.losses = torch.compile(self.loss.__call__) if compile else self.loss
        groups = self.groups()
        self.parameters = [parameter for group in groups for parameter in group]
        of_group = [{"params": group, "lr": rate} for group, rate in zip(groups, self.rates(0), strict=True)]
        self.optimiser = torch.optim.Adam(of_group, eps=1e-5, fused=True)
        self.generator = torch.Generator().manual_seed(seed)
        self.auxiliary = list(auxiliary)
        # Where a guide acts in some of the steps, the env says in which.
        self.shares_control = "agent_acts" in env.observation_spec
        beside = [key for auxiliary in self.auxiliary for key in auxiliary.keys]
        seen = dict.fromkeys([*in_keys, *self.policy.in_keys])
        acts = ["agent_acts"] if self.shares_control else []
        before = [*seen, "action", "action_log_prob", *beside, *acts]
        after = [*in_keys, "reward", "done", "terminated"]
        self.keys = [*before, *(("next", key) for key in after)]
        self.learned_from = [*before, "advantage", "value_target"]

    def build_policy(
        self, env: EnvBase, in_keys: Sequence[str], hidden: Sequence[int], scale: float, gain: float
    ) -> ProbabilisticTensorDictSequential:
        """The network that acts."""
        return networks.actor(env, in_keys, hidden, scale, gain)

    def groups(self) -> list[list[nn.Parameter]]:
        """The parameters that learn, those together that learn at one rate."""
        return [[p for p in self.loss.parameters() if p.requires_grad]]

    def rates(self, progress: float) -> list[float]:
        """The learning rate of each group."""
        return [self.learning_rate(progress)]

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Learn from a batch of rollouts.

        Args:
            batch: [B, T] with the observed entries, `action`, `action_log_prob` and, under `next`, the observed
                entries, `reward`, `done` and `terminated`. A truncated episode counts as going on.
            progress: share of the run that is over, for the schedules.

        Returns:
            Means over the update of each loss, the approximate KL divergence and the share of clipped ratios.
        """
        for group, rate in zip(self.optimiser.param_groups, self.rates(progress), strict=True):
            group["lr"] = rate
        if self.loss.entropy_bonus:
            self.loss.entropy_coeff.fill_(self.entropy(progress))
        self.advantage(batch)
        flat = batch.select(*self.learned_from).reshape(-1)
        reports = []
        size = len(flat) // self.minibatches
        for _ in range(self.epochs):
            order = torch.randperm(len(flat), generator=self.generator)[: size * self.minibatches]
            for minibatch in flat[order.to(flat.device)].split(size):
                losses = self._losses(minibatch)
                total = losses["loss_objective"] + losses["loss_critic"]
                if self.loss.entropy_bonus:
                    total = total + losses["loss_entropy"]
                for auxiliary in self.auxiliary:
                    losses[f"loss_{auxiliary.name}"] = auxiliary(self.policy, minibatch)
                    total = total + auxiliary.coefficient(progress) * losses[f"loss_{auxiliary.name}"]
                self.optimiser.zero_grad()
                total.backward()
                torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
                self.optimiser.step()
                reports.append(losses.detach())
        names = list(reports[0].keys())
        means = {name: float(torch.stack([report[name] for report in reports]).mean()) for name in names}
        return means | {"learning_rate": self.learning_rate(progress)}

    def _losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """TorchRL's losses; where a guide acted instead of the agent, only the critic learns."""
        if not self.shares_control:
            return self.losses(minibatch)
        acted = minibatch[minibatch["agent_acts"].squeeze(-1)]
        if len(acted) < 2:  # one advantage cannot be standardised
            losses = self.losses(minibatch)
            for name in {"loss_objective", "loss_entropy"}.intersection(losses.keys()):
                losses[name] = losses[name] * 0
            return losses
        losses = self.losses(acted)
        losses["loss_critic"] = self.loss.loss_critic(minibatch)[0].mean()
        return losses

    def state_dict(self) -> dict[str, Any]:
        """Everything an update depends on besides the batch."""
        return {
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
