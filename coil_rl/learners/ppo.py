"""Proximal policy optimisation, PPO (paper equation 92; Schulman et al. 2017).

A critic turns a batch of rollouts into advantages A (generalised advantage estimation). The policy
then takes several passes over the batch in minibatches. Clipping the probability ratio keeps it
near the policy that collected the batch:

    loss = -mean(min(r A, clip(r, 1 - clip, 1 + clip) A)),  r = pi(a | s) / pi_old(a | s)
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, TypedDict

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs import EnvBase

from coil_rl.learners import networks
from coil_rl.learners.anchor import Anchor, start_tests
from coil_rl.learners.batches import (
    AGENT_ACTS,
    OF_POLICY,
    SEEN,
    Minibatches,
    RowMinibatches,
    add_advantages,
    guide_may_act,
    of_agent,
    report_of,
    standardise,
)
from coil_rl.learners.encoders import Mlp, without_memory
from coil_rl.learners.extension import Extension, Extensions, SummedRewards
from coil_rl.learners.gradient import GradientStep, means, tensors_of
from coil_rl.learners.learner import Callback, Cases, Learner, Stateful
from coil_rl.learners.normaliser import RawObservations, RunningStatistics, normaliser
from coil_rl.learners.policy import UNCLIPPED, Entries, Policy, by_key
from coil_rl.learners.rewards import RewardScale
from coil_rl.ranges import Count, NonNegative, Positive, Seed, Share, checked
from coil_rl.schedules import Linear, Schedule, schedule
from coil_rl.transforms.action_space import nested_key


class OnPolicySettings(TypedDict, total=False):
    """Arguments that every on-policy learner takes as `PPO` does."""

    hidden: Sequence[int]
    network: Mlp | None
    normalise: bool | Literal["auto"] | Sequence[NestedKey]
    scale_rewards: bool
    action_scale: Positive
    action_gain: NonNegative
    squash: bool
    gamma: Share
    minibatches: Count
    max_grad_norm: Positive
    anchor: Anchor | None
    auxiliary: Sequence[Extension]
    seed: Seed


class PPOSettings(OnPolicySettings, total=False):
    """All settings of `PPO`."""

    learning_rate: NonNegative | Schedule
    gae_lambda: Share
    clip: Positive
    epochs: Count
    entropy: NonNegative | Schedule
    critic: NonNegative
    compile: bool | Literal["auto"]


@checked
class PPO(Stateful, Learner):
    """The PPO learner, and the base class of the other on-policy learners.

    COIL is PPO with `guide_action` among `in_keys`. What is not PPO is in other files: `extensions`
    (`Extension`), a memory (`RowMinibatches`), and a guide that acts in some of the steps
    (`losses_of_agent`). Subclasses override `build_policy`, `build_critic`, `objective`, `losses`,
    `parameter_groups` and `learning_rates`.

    A value out of range, or an action that no policy can choose, is a `ValueError`; an entry that
    the env does not have a `KeyError`.

    Args:
        env: the env, for its specs.
        in_keys: entries that policy and critic observe.
        hidden: widths of the hidden layers of both networks, without `network`.
        network: architecture of both networks; None: `Mlp(hidden)`.
        normalise: whether to normalise what is observed, "auto" to decide it on the first batch, or
            the entries to normalise, see `Normaliser`.
        scale_rewards: whether rewards are divided by the running deviation of returns, see
            `RewardScale`.
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
        auxiliary: further extensions, such as losses of the policy (`KickstartLoss`).
        seed: of the order of minibatches.

    Attributes:
        policy: writes `action` and `action_log_prob`.
        head: the part of the policy that is computed for each minibatch, see `parts_of`.
        critic: writes `state_value`.
        keys: entries that a batch must have.
        extensions: what is added to PPO.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> from coil_rl.run.rollout import Rollout
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_envs=64)
        >>> ppo = PPO(env)
        >>> metrics = ppo.update(Rollout(env, ppo.policy, steps=32).collect())
    """

    with_memory: ClassVar[bool] = True  # whether the learner can train a network with a memory
    compilable: ClassVar[bool] = True  # whether the update can be compiled
    critic: TensorDictModuleBase
    policy: Policy
    parts: ClassVar[tuple[str, ...]] = ("policy", "critic", "gradient", "sampler", "extensions")

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey] = ("observation",),
        *,
        hidden: Sequence[int] = (64, 64),
        network: Mlp | None = None,
        normalise: bool | Literal["auto"] | Sequence[NestedKey] = False,
        scale_rewards: bool = False,
        action_scale: Positive = 0.5,
        action_gain: NonNegative = 0.01,
        squash: bool = True,
        learning_rate: NonNegative | Schedule = Linear(1e-3, 0.0),
        gamma: Share = 0.99,
        gae_lambda: Share = 0.95,
        clip: Positive = 0.2,
        epochs: Count = 5,
        minibatches: Count = 16,
        entropy: NonNegative | Schedule = 0.0,
        critic: NonNegative = 0.5,
        max_grad_norm: Positive = 0.5,
        compile: bool | Literal["auto"] = "auto",
        anchor: Anchor | None = None,
        auxiliary: Sequence[Extension] = (),
        seed: Seed = 0,
    ) -> None:
        self.learning_rate, self.entropy = schedule(learning_rate), schedule(entropy)
        in_keys = [nested_key(key) for key in in_keys]
        network = network or Mlp(hidden)
        if not self.with_memory:
            without_memory(network, type(self).__name__)

        self.anchor, self.normaliser = anchor, normaliser(env, in_keys, normalise)
        self.inputs = networks.inputs_of(env, self.normaliser, anchor)
        self.policy = self.build_policy(
            env,
            in_keys,
            network,
            scale=action_scale,
            gain=action_gain,
            squash=squash,
            inputs=self.inputs,
            anchor=anchor,
        )
        self.critic = self.build_critic(env, in_keys, network)
        self.first_inputs, memory, self.head = networks.parts_of(self.policy)
        self.values = networks.values_of(self.critic, self.first_inputs)
        statistics = [RewardScale(gamma)] if scale_rewards else []
        self.extensions = self._extensions(env, in_keys, statistics, auxiliary)

        self.gamma, self.gae_lambda = gamma, gae_lambda
        # As TorchRL, in float32.
        self.clip_bounds = torch.tensor([-clip, clip]).log1p().tolist()
        self.critic_coefficient, self.has_bonus = critic, self.entropy(0) > 0
        self.sampler = Minibatches(epochs, minibatches, seed)
        if memory is not None:
            self.sampler = RowMinibatches(epochs, minibatches, seed, memory)
        self.gradient = GradientStep(
            self.all_losses,
            self.parameter_groups(),
            tensors_of(self.policy, self.critic),
            self.learning_rates,
            eps=1e-5,
            max_grad_norm=max_grad_norm,
            compile=compile,
            compilable=self.compilable and memory is None and not guide_may_act(env),
        )
        self.on_tensors = by_key(self.head) and by_key(self.values)
        self._set_keys(env, in_keys)

    def build_policy(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp, **options: Any
    ) -> Policy:
        """Return the policy; `options` are further arguments of `networks.actor`."""
        return networks.actor(env, in_keys, network, **options)

    def build_critic(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp
    ) -> TensorDictModuleBase:
        """Return the critic."""
        return networks.critic(env, in_keys, network, self.inputs)

    def _extensions(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        of_rewards: Sequence[Extension],
        auxiliary: Sequence[Extension],
    ) -> Extensions:
        """Return what is added to the algorithm, in the order in which it acts."""
        for own in auxiliary:
            own.meet(env, self.head, None)
        each = [*of_rewards]
        if (reward_key := unravel_key(("next", env.reward_key))) != ("next", "reward"):
            each.insert(0, SummedRewards(reward_key))
        if self.normaliser is not None:
            each.append(RunningStatistics(self.normaliser))
        return Extensions([*each, *auxiliary, RawObservations(env, in_keys, self.normaliser)])

    def _set_keys(self, env: EnvBase, in_keys: Sequence[NestedKey]) -> None:
        """Set the entries that batches and minibatches need."""
        clips = UNCLIPPED in self.policy.out_keys
        self.sample_key = UNCLIPPED if clips else env.action_key
        valued = [*in_keys, *self.critic.in_keys]
        observed = dict.fromkeys([*valued, *self.policy.in_keys])
        read = [*observed, self.sample_key, "action_log_prob", *self.extensions.keys]
        if guide_may_act(env):
            read.append(AGENT_ACTS)
        after = [*dict.fromkeys(valued), "done", "terminated", env.reward_key]
        self.keys: list[NestedKey] = [*read, *(unravel_key(("next", key)) for key in after)]
        self.minibatch_keys = [*read, "advantage", "value_target"]

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
            Means over the minibatches of the losses and of the other values that TorchRL's PPO
            reports; the learning rate; and the metrics of the extensions.
        """
        rows, weights = self.prepare(batch, progress), self.loss_weights(progress)
        steps = [self.gradient(minibatch, weights) for minibatch in self.sampler.draw(rows)]
        known = {
            "learning_rate": self.learning_rate(progress),
            "compiled": float(self.gradient.compile is True),
        }
        return self.report(steps, weights) | known | self.extensions.finish(batch, progress)

    def prepare(self, batch: TensorDictBase, progress: float) -> Entries:
        """Apply the schedules and compute advantages; returns what minibatches are drawn from."""
        self.gradient.begin(progress)
        self.extensions.prepare(batch)
        add_advantages(batch, self.critic, self.gamma, self.gae_lambda)
        rows = self.sampler.rows(batch, self.minibatch_keys)
        rows["action"] = rows.pop(self.sample_key)
        if self.first_inputs is not None:
            with torch.no_grad():  # they do not depend on weights
                self.first_inputs(rows)
        return rows

    def loss_weights(self, progress: float) -> dict[str, float]:
        """Return the weights of the losses in the sum that an update minimises."""
        weights = {"loss_objective": 1.0, "loss_critic": 1.0}
        if self.has_bonus:
            weights["loss_entropy"] = self.entropy(progress)
        return self.extensions.weights(weights, progress)

    def all_losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return all losses of a minibatch [N] by name, and other values that are reported."""
        return self.losses_of_agent(minibatch) | self.extensions.losses(self.head, minibatch)

    def losses_of_agent(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return `losses` of the steps in which the agent acted, that of the critic of all."""
        if AGENT_ACTS not in minibatch:
            return self.losses(minibatch)
        agent_steps = of_agent(minibatch)
        if len(agent_steps["advantage"]) >= 2:
            return self.losses(agent_steps) | {"loss_critic": self.critic_loss(minibatch)[0]}
        losses = self.losses(minibatch)  # one advantage cannot be standardised
        unused = losses.keys() & {"loss_objective", "loss_entropy"}
        return losses | {name: losses[name] * 0 for name in unused}

    def losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the losses of a minibatch [N]: `loss_objective`, `loss_critic`, others.

        What is no scalar is for the report.
        """
        rows = minibatch if self.on_tensors else TensorDict(minibatch, len(minibatch["advantage"]))
        density = self.head.density(rows)
        log_prob = density.log_prob(rows["action"])
        losses = {"loss_objective": self.objective(log_prob, rows).mean()}
        if self.has_bonus:
            entropy = density.entropy()
            losses |= {"entropy": entropy.mean(), "loss_entropy": -entropy.mean()}
        losses["loss_critic"], value = self.critic_loss(rows)
        log_ratio = (log_prob - rows["action_log_prob"]).unsqueeze(-1)
        return losses | dict(zip(SEEN, (log_ratio, value, rows["value_target"]), strict=True))

    def objective(self, log_prob: Tensor, minibatch: Entries) -> Tensor:
        """Return the loss of the policy in each step of a minibatch [N].

        Args:
            log_prob: log pi(a | s), [N].
            minibatch: with `action_log_prob` [N], log pi_old(a | s), and `advantage` [N, 1].
        """
        log_ratio = log_prob - minibatch["action_log_prob"]
        advantage = standardise(minibatch["advantage"], 1e-4).squeeze(-1)
        clipped = log_ratio.clamp(*self.clip_bounds)
        return -torch.minimum(log_ratio.exp() * advantage, clipped.exp() * advantage)

    def critic_loss(self, minibatch: Entries) -> tuple[Tensor, Tensor]:
        """Return the loss of the critic for a minibatch [N], and its values [N, 1]."""
        value = self.values(minibatch)["state_value"]
        errors = F.mse_loss(minibatch["value_target"], value, reduction="none")
        return (self.critic_coefficient * errors).mean(), value

    def report(
        self, steps: Sequence[Mapping[str, Tensor]], weights: Mapping[str, float]
    ) -> dict[str, float]:
        """Return the means over the minibatches of the losses and of what `report_of` adds."""
        means_of = means(steps)
        if "loss_entropy" in means_of:
            means_of["loss_entropy"] *= weights["loss_entropy"]
        if SEEN[0] not in steps[0]:
            return means_of
        values = report_of(steps, self.clip_bounds) | means_of
        first = ("loss_objective", *OF_POLICY, "entropy", "loss_entropy", "loss_critic")
        return {name: values[name] for name in first if name in values} | values

    def callbacks(self, cases: Cases) -> Sequence[Callback]:
        """Return the start test of an anchored policy."""
        return start_tests(self.anchor, self.policy, cases)

    def check_batch(self, rows: int, steps: int) -> None:
        """Raise a `ValueError` if a batch [B, T] is too small for the minibatches.

        Args:
            rows: B, of the env. With a memory each minibatch has whole rows.
            steps: T, of each row.
        """
        self.sampler.check(rows, steps)
