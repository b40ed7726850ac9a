"""Proximal policy optimisation with clipped probability ratios (paper equation 92; Schulman et al. 2017).

A critic turns a batch of rollouts into advantages A (generalised advantage estimation). The policy
then takes several passes over the batch in minibatches. Clipping the probability ratio keeps it
near the policy that collected the batch:

    loss = -mean(min(r A, clip(r, 1 - clip, 1 + clip) A)),  r = pi(a | s) / pi_old(a | s)
"""

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs import EnvBase
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss, LossModule
from torchrl.objectives.value import GAE

from coil_rl.envs.limits import LARGEST_SEED, check_range
from coil_rl.errors import UserError
from coil_rl.learners import networks
from coil_rl.learners.anchor import Anchor
from coil_rl.learners.encoders import Mlp, without_memory
from coil_rl.learners.gradient import GradientStep
from coil_rl.learners.kickstart import KickstartLoss
from coil_rl.learners.normaliser import normaliser
from coil_rl.learners.state import Stateful
from coil_rl.schedules import Linear, Schedule, schedule
from coil_rl.transforms.action_space import nested_key


class PPO(Stateful):
    """The PPO learner, and the base class of the other on-policy learners.

    COIL is PPO with `guide_action` among `in_keys`. Where a guide acts in some of the steps
    (`agent_acts` is false), the policy learns from the agent's steps only, and the critic from all.
    Subclasses override `build_loss`, `losses`, `build_networks`, `parameter_groups` and
    `learning_rates`.

    A policy with a memory (`network` is a `Gru`) learns from minibatches of whole rows of a batch,
    [N, T]. It remembers anew from the state that was stored in the first step of each row; then
    their steps are a minibatch as any other.

    A value out of range, or an action that no policy can choose, is a `ValueError`; an entry that
    the env does not have a `KeyError`.

    Args:
        env: the env, for its specs.
        in_keys: entries that policy and critic observe.
        hidden: widths of the hidden layers of both networks, without `network`.
        network: architecture of both networks; None: `Mlp(hidden)`.
        normalise: whether to normalise what is observed, or the entries to normalise, see
            `Normaliser`.
        action_scale: initial standard deviation of the policy.
        action_gain: initial scale of the last weights of the policy; with 0 its mean is 0
            everywhere.
        squash: whether bounded actions are squashed by tanh; otherwise samples beyond the bounds
            are clipped.
        learning_rate: of Adam, a number or a schedule.
        gamma: discount.
        gae_lambda: lambda of generalised advantage estimation.
        clip: clipping range of the probability ratio.
        epochs: passes over each batch.
        minibatches: minibatches per pass.
        entropy: coefficient of the entropy bonus, a number or a schedule.
        critic: coefficient of the critic's loss.
        max_grad_norm: gradients are scaled down to this norm.
        compile: whether to compile the update, see `GradientStep`.
        anchor: makes the policy start as its guide.
        auxiliary: additional losses of the policy.
        seed: of the order of minibatches.

    Attributes:
        policy: writes `action` and `action_log_prob`.
        head: the part of the policy after its memory; all of it without one.
        critic: writes `state_value`.
        keys: entries that a batch must have.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.run.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_envs=64)
        >>> ppo = PPO(env)
        >>> metrics = ppo.update(Rollout(env, ppo.policy, steps=32).collect())
    """

    # What the learner trains: "agent" (a policy, from rewards), "imitation" (a policy, from a
    # guide's actions) or "guides" (guides besides an agent).
    kind: ClassVar[str] = "agent"
    with_memory: ClassVar[bool] = True  # whether the learner can train a network with a memory
    compilable: ClassVar[bool] = True  # whether the update can be compiled
    parts: ClassVar[tuple[str, ...]] = ("policy", "critic", "gradient", "generator", "anchor")

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        network: Mlp | None = None,
        normalise: bool | Sequence[NestedKey] = False,
        action_scale: float = 0.5,
        action_gain: float = 0.01,
        squash: bool = True,
        learning_rate: float | Schedule = Linear(1e-3, 0.0),
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip: float = 0.2,
        epochs: int = 5,
        minibatches: int = 16,
        entropy: float | Schedule = 0.0,
        critic: float = 0.5,
        max_grad_norm: float = 0.5,
        compile: bool | Literal["auto"] = "auto",
        anchor: Anchor | None = None,
        auxiliary: Sequence[KickstartLoss] = (),
        seed: int = 0,
    ) -> None:
        self.learning_rate, self.entropy = schedule(learning_rate), schedule(entropy)
        check_range(0, action_gain=action_gain, learning_rate=self.learning_rate(0))
        check_range(0, critic=critic, entropy=self.entropy(0))
        check_range(
            0, above=True, action_scale=action_scale, clip=clip, max_grad_norm=max_grad_norm
        )
        check_range(1, epochs=epochs, minibatches=minibatches)
        check_range(0, LARGEST_SEED, seed=seed)
        self.epochs, self.minibatches = epochs, minibatches
        self.auxiliary, self.anchor = list(auxiliary), anchor
        in_keys = [nested_key(key) for key in in_keys]
        network = network or Mlp(hidden)
        if not self.with_memory:
            without_memory(network, type(self).__name__)
        self.normaliser = normaliser(env, in_keys, normalise)
        self.policy, self.critic = self.build_networks(
            env,
            in_keys,
            network,
            scale=action_scale,
            gain=action_gain,
            squash=squash,
            anchor=anchor,
        )
        self.memory, self.head = networks.split_memory(self.policy)
        self.advantage = Advantages(self.critic, gamma, gae_lambda)
        self.loss = self.build_loss(
            clip,
            entropy_bonus=self.entropy(0) > 0,
            entropy_coeff=self.entropy(0),
            critic_coeff=critic,
            loss_critic_type="l2",
            functional=False,
        )
        self.guide_may_act = "agent_acts" in env.observation_spec
        self.gradient = GradientStep(
            self.all_losses,
            self.parameter_groups(),
            [self.policy, self.critic, self.loss],
            self.learning_rates,
            eps=1e-5,
            max_grad_norm=max_grad_norm,
            compile=compile,
            compilable=self.compilable and self.memory is None and not self.guide_may_act,
        )
        self.generator = torch.Generator().manual_seed(seed)
        self.sample_key = (
            networks.UNCLIPPED if networks.UNCLIPPED in self.policy.out_keys else env.action_key
        )
        self.reward_key = unravel_key(("next", env.reward_key))
        read = [
            *dict.fromkeys([*in_keys, *self.policy.in_keys]),
            self.sample_key,
            "action_log_prob",
        ]
        read += [key for auxiliary_loss in self.auxiliary for key in auxiliary_loss.keys]
        read += ["agent_acts"] if self.guide_may_act else []
        valued = dict.fromkeys([*in_keys, *self.critic.in_keys])
        after = [unravel_key(("next", key)) for key in (*valued, "done", "terminated")]
        self.keys: list[NestedKey] = [*read, *after, self.reward_key]
        self.minibatch_keys = [*read, "advantage", "value_target"]

    def build_networks(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp, **options: Any
    ) -> tuple[ProbabilisticTensorDictSequential, TensorDictModuleBase]:
        """Return policy and critic; `options` are those of `networks.actor`."""
        policy = networks.actor(env, in_keys, network, normaliser=self.normaliser, **options)
        return policy, networks.critic(env, in_keys, network, self.normaliser)

    def build_loss(self, clip: float, **options: Any) -> LossModule:
        """Return TorchRL's loss of policy and critic; `options` are those of any such loss."""
        return ClippedLoss(
            self.head, self.critic, clip_epsilon=clip, normalize_advantage=True, **options
        )

    def parameter_groups(self) -> list[list[nn.Parameter]]:
        """Return the parameters that the optimiser updates, grouped by learning rate."""
        return [[*self.policy.parameters(), *self.critic.parameters()]]

    def learning_rates(self, progress: float) -> list[float]:
        """Return the learning rate of each parameter group."""
        return [self.learning_rate(progress)] * len(self.gradient.groups)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Learn from a batch of rollouts.

        Args:
            batch: [B, T] with `keys`. A truncated episode is bootstrapped from the value of its
                last state.
            progress: of the run, in [0, 1], for the schedules.

        Returns:
            Means over the minibatches of the losses and of the other values that TorchRL's loss
            reports, and the learning rate.
        """
        rows, weights = self.prepare(batch, progress), self.loss_weights(progress)
        reports = [self.gradient(minibatch, weights) for minibatch in self.draw_minibatches(rows)]
        known = {
            "learning_rate": self.learning_rate(progress),
            "compiled": float(self.gradient.compile is True),
        }
        return self.gradient.means(reports) | known | self.finish(batch, progress)

    def all_losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return all losses of a minibatch by name, and the other values that TorchRL's loss reports."""
        losses = self.masked_losses(minibatch)
        for auxiliary in self.auxiliary:
            losses[f"loss_{auxiliary.name}"] = auxiliary(self.head, minibatch)
        return losses

    def loss_weights(self, progress: float) -> dict[str, float]:
        """Return the weights of the losses in the sum that an update minimises."""
        learns = float(not self.policy_waits(progress))
        weights = {"loss_objective": learns, "loss_critic": 1.0}
        if getattr(self.loss, "entropy_bonus", False):
            weights["loss_entropy"] = learns
        return weights | {
            f"loss_{each.name}": learns * each.coefficient_at(progress) for each in self.auxiliary
        }

    def policy_waits(self, progress: float) -> bool:
        """Return whether only the critic learns."""
        return self.anchor is not None and self.anchor.waits(progress)

    def finish(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Learn the statistics of the observations, and set the noise of an anchored policy, after an update.

        The policy has collected the batch with the earlier statistics, and must learn from it with
        the same ones. Returns the metrics of the anchor, if there is one.
        """
        if self.normaliser is not None:
            self.normaliser.learn(batch)
        return {} if self.anchor is None else self.anchor.set_noise(progress)

    def prepare(self, batch: TensorDictBase, progress: float) -> TensorDictBase:
        """Apply the schedules and compute advantages; returns the rows to learn from, [B * T], with a memory [B, T]."""
        self.gradient.begin(progress)
        if getattr(self.loss, "entropy_bonus", False):
            self.loss.entropy_coeff.fill_(self.entropy(progress))
        if self.reward_key != ("next", "reward"):  # several agents: their rewards are summed
            reward = batch[self.reward_key]
            batch["next", "reward"] = reward.sum(tuple(range(batch.ndim, reward.ndim)))[..., None]
        if self.anchor is not None:
            batch["next", "reward"] = batch["next", "reward"] / self.anchor.unit
        self.advantage(batch)
        rows = batch.select(*self.minibatch_keys)
        rows = rows.reshape(-1) if self.memory is None else rows.reshape(-1, batch.shape[-1])
        # Some losses of TorchRL read the sample of the policy, others `action`.
        return rows.set("action", rows[self.sample_key])

    def draw_minibatches(self, rows: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yield the minibatches of all passes over the rows, each pass in a random order."""
        size = len(rows) // self.minibatches
        if self.memory is not None and size < 1:
            problem = f"minibatches={self.minibatches} are more than the {len(rows)} envs"
            needed = "with a memory each needs all steps of an env"
            raise UserError(f"{problem}, but {needed}; take fewer minibatches or more envs")
        if size * rows.shape[1:].numel() < 2:  # one advantage cannot be standardised
            raise ValueError(
                f"minibatches={self.minibatches} leaves less than 2 of {rows.numel()} frames to each"
            )
        for _ in range(self.epochs):
            order = torch.randperm(len(rows), generator=self.generator)[: size * self.minibatches]
            yield from map(self.remember, rows[order.to(rows.device)].split(size))

    def remember(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the steps of whole rows [N, T] with `remembered`, [N * T]; without a memory, the minibatch."""
        if self.memory is None:
            return minibatch
        with set_recurrent_mode(True):
            remembered = self.memory(minibatch.select(*self.memory.in_keys))[networks.REMEMBERED]
        return minibatch.copy().set(networks.REMEMBERED, remembered).reshape(-1)

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return TorchRL's losses of a minibatch [N]: scalars, with `loss_objective` and `loss_critic`."""
        return self.loss(minibatch)

    def masked_losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the losses of a minibatch, those of the policy for the steps in which the agent acted only."""
        if not self.guide_may_act:
            return self.losses(minibatch)
        agent_steps = minibatch[minibatch["agent_acts"].squeeze(-1)]
        if len(agent_steps) < 2:  # one advantage cannot be standardised
            losses = self.losses(minibatch)
            for name in {"loss_objective", "loss_entropy"}.intersection(losses.keys()):
                losses[name] = losses[name] * 0
            return losses
        losses = self.losses(agent_steps)
        losses["loss_critic"] = self.loss.loss_critic(minibatch)[0].mean()
        return losses


class ClippedLoss(ClipPPOLoss):
    """TorchRL's loss of the clipped objective, with the same numbers, in less time.

    It leaves out the searches for options that are not used here, which take longer than small
    networks do.
    """

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses of a minibatch [N] and TorchRL's other values, scalars."""
        rows = tensordict.copy()
        advantage, target = rows["advantage"], rows["value_target"]
        advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-4)
        *modules, last = self.actor_network.module
        for module in modules:
            rows = module(rows)
        distribution = last.get_dist(rows)
        log_ratio = (distribution.log_prob(rows["action"]) - rows["action_log_prob"]).unsqueeze(-1)
        ratio, clipped = log_ratio.exp(), log_ratio.clamp(*self._clip_bounds)
        gain = torch.minimum(ratio * advantage, clipped.exp() * advantage)
        value = self.critic_network(rows)["state_value"]
        error = F.mse_loss(target, value, reduction="none")
        with torch.no_grad():
            weights = log_ratio.squeeze(-1)
            size = (2 * weights.logsumexp(0) - (2 * weights).logsumexp(0)).exp()
            unexplained = torch.var(target - value, correction=0, dim=0)
            variance = torch.var(target, correction=0, dim=0) + torch.finfo(target.dtype).eps
        losses = {
            "loss_objective": -gain.mean(),
            "clip_fraction": (clipped != log_ratio).to(ratio.dtype).mean(),
            "kl_approx": (-log_ratio.detach()).mean(),
        }
        if self.entropy_bonus:
            entropy = self._get_entropy(distribution, advantage.shape[:-1])
            losses |= {
                "entropy": entropy.detach().mean(),
                "loss_entropy": self._weighted_loss_entropy(entropy).mean(),
            }
        losses |= {
            "loss_critic": (self.critic_coeff * error).mean(),
            "explained_variance": 1.0 - unexplained / variance,
            "ESS": size / len(weights),
            "max_ratio": ratio.detach().max(),
            "mean_ratio": ratio.detach().mean(),
        }
        return TensorDict(losses)


class Advantages:
    """Generalised advantage estimation (Schulman et al. 2016) with one critic evaluation per state.

    The state after a step is the state before the next step, unless the episode ended. So the
    critic evaluates each state once, and in addition the last states of the batch and those of
    truncated episodes.
    """

    def __init__(self, critic: TensorDictModuleBase, gamma: float, gae_lambda: float) -> None:
        check_range(0, 1, gamma=gamma, gae_lambda=gae_lambda)
        self.critic = critic
        self.estimate = GAE(gamma=gamma, lmbda=gae_lambda, value_network=None, vectorized=False)

    @torch.no_grad()
    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Write `advantage` and `value_target` [B, T, 1] into a batch [B, T] of consecutive steps."""
        after = batch["next"]
        value, last = self._values(batch), self._values(after[..., -1:])
        next_value = torch.cat([value[..., 1:, :], last], -2)
        truncated = (after["done"] & ~after["terminated"]).squeeze(-1)
        next_value[truncated] = self._values(after.select(*self.critic.in_keys)[truncated])
        batch["state_value"], batch["next", "state_value"] = value, next_value
        self.estimate(batch)
        return batch

    def _values(self, states: TensorDictBase) -> Tensor:
        return self.critic(states.select(*self.critic.in_keys))["state_value"]


def standardise(advantage: Tensor) -> Tensor:
    """Scale to mean 0 and standard deviation 1 over all entries."""
    return (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
