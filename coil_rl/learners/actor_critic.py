"""What the on-policy learners share: a network that acts, one that judges states, and how a batch becomes an update."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from coil_rl.learners import networks
from coil_rl.learners.advantages import standardised
from coil_rl.learners.guide_loss import AuxiliaryLoss
from coil_rl.learners.limits import check_numbers
from coil_rl.schedules import Schedule, schedule


class ActorCritic:
    """Policy, critic, optimiser and the update; what it is that they minimise is the business of each learner.

    Such a learner sets `advantage`, which writes `advantage` and `value_target` [B, T, 1] into a batch, and `loss`,
    TorchRL's; `losses`, where it is not simply called, gives `loss_objective` and `loss_critic` of a minibatch.

    Args:
        env: for the shapes of what is observed and done.
        in_keys: what policy and critic observe. COIL is to have `guide_action` among them.
        hidden: widths of the hidden layers of both networks.
        action_scale: standard deviation of the policy at the start.
        action_gain: size of the weights behind the mean of the policy at the start; with 0 the mean is 0 everywhere.
        learning_rate: of Adam, a number or a schedule over the run.
        minibatches: parts of a pass over the batch.
        max_grad_norm: gradients are scaled down to this norm.
        auxiliary: more losses of the policy.
        seed: of the order of minibatches.

    Attributes:
        policy: writes `action` and `action_log_prob`.
        critic: writes `state_value`.
        keys: what a batch must hold.

    Raises:
        ValueError: for a value outside its range.
    """

    advantage: Callable[[TensorDictBase], TensorDictBase]
    loss: LossModule
    epochs = 1
    entropy: Schedule | None = None
    standardise = False  # advantages, in each minibatch

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        action_scale: float = 0.5,
        action_gain: float = 0.01,
        learning_rate: float | Schedule = 3e-4,
        minibatches: int = 1,
        max_grad_norm: float = 0.5,
        auxiliary: Sequence[AuxiliaryLoss] = (),
        seed: int = 0,
    ) -> None:
        self.learning_rate = schedule(learning_rate)
        check_numbers(1, hidden=min(hidden, default=1), minibatches=minibatches)
        check_numbers(0, action_gain=action_gain, learning_rate=self.learning_rate(0))
        check_numbers(0, above=True, action_scale=action_scale, max_grad_norm=max_grad_norm)
        check_numbers(0, 2**63 - 1, seed=seed)
        self.minibatches, self.max_grad_norm = minibatches, max_grad_norm
        self.policy = self.build_policy(env, in_keys, hidden, action_scale, action_gain)
        self.critic = self.build_critic(env, in_keys, hidden)
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

    def build_critic(self, env: EnvBase, in_keys: Sequence[str], hidden: Sequence[int]) -> TensorDictModuleBase:
        """The network that judges states."""
        return networks.critic(env, in_keys, hidden)

    def groups(self) -> list[list[nn.Parameter]]:
        """The parameters that learn, those together that learn at one rate."""
        return [[*self.policy.parameters(), *self.critic.parameters()]]

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
            Means over the update of each loss and of what else TorchRL says of it.
        """
        flat = self.prepare(batch, progress)
        reports = [self.learn(minibatch, progress) for minibatch in self.passes(flat, self.epochs)]
        names = list(reports[0].keys())
        means = {name: float(torch.stack([report[name] for report in reports]).mean()) for name in names}
        return means | {"learning_rate": self.learning_rate(progress)}

    def prepare(self, batch: TensorDictBase, progress: float) -> TensorDictBase:
        """Bring the schedules up to date; returns what is learned from, [B * T], with its advantages."""
        for group, rate in zip(self.optimiser.param_groups, self.rates(progress), strict=True):
            group["lr"] = rate
        if self.entropy is not None and self.loss.entropy_bonus:
            self.loss.entropy_coeff.fill_(self.entropy(progress))
        self.advantage(batch)
        return batch.select(*self.learned_from).reshape(-1)

    def passes(self, flat: TensorDictBase, epochs: int) -> Iterator[TensorDictBase]:
        """Minibatches of several passes over the rows, each in a random order.

        Raises:
            ValueError: if there is one row to a minibatch, or none: one advantage cannot be standardised.
        """
        size = len(flat) // self.minibatches
        if size < 2:
            raise ValueError(f"minibatches={self.minibatches} leaves less than 2 of {len(flat)} frames to each")
        for _ in range(epochs):
            order = torch.randperm(len(flat), generator=self.generator)[: size * self.minibatches]
            yield from flat[order.to(flat.device)].split(size)

    def learn(self, minibatch: TensorDictBase, progress: float) -> TensorDictBase:
        """One step of the optimiser; returns the losses of the minibatch."""
        losses = self.shared_losses(minibatch)
        total = losses["loss_objective"] + losses["loss_critic"]
        if "loss_entropy" in losses:
            total = total + losses["loss_entropy"]
        for auxiliary in self.auxiliary:
            losses[f"loss_{auxiliary.name}"] = auxiliary(self.policy, minibatch)
            total = total + auxiliary.coefficient(progress) * losses[f"loss_{auxiliary.name}"]
        self.step(total)
        return losses.detach()

    def step(self, total: Tensor) -> None:
        """Follow the gradient of a loss."""
        self.optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
        self.optimiser.step()

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """TorchRL's losses of a minibatch [N], scalars."""
        if self.standardise:
            minibatch = minibatch.copy().set("advantage", standardised(minibatch["advantage"]))
        losses: TensorDictBase = self.loss(minibatch)
        return losses

    def shared_losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """The losses; where a guide acted instead of the agent, only the critic learns."""
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
