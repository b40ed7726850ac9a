"""Proximal policy optimisation, PPO (paper equation 92; Schulman et al. 2017).

A critic turns a batch of rollouts into advantages A (generalised advantage estimation). The policy
then takes several passes over the batch in minibatches. Clipping the probability ratio keeps it
near the policy that collected the batch:

    loss = -mean(min(r A, clip(r, 1 - clip, 1 + clip) A)),  r = pi(a | s) / pi_old(a | s)
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar, Literal, TypedDict

from tensordict import TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import nn
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from coil_rl.learners import networks
from coil_rl.learners.advantages import Advantages
from coil_rl.learners.anchor import Anchor, start_tests
from coil_rl.learners.clipped_loss import ClippedLoss
from coil_rl.learners.encoders import Mlp, without_memory
from coil_rl.learners.extension import Extension
from coil_rl.learners.extensions import extensions_of
from coil_rl.learners.gradient import GradientStep
from coil_rl.learners.guided_steps import AGENT_ACTS, LossesOfAgentSteps, guide_may_act
from coil_rl.learners.lean_update import LeanUpdate
from coil_rl.learners.learner import Callback, Cases, Learner
from coil_rl.learners.minibatches import RowMinibatches, minibatches_of
from coil_rl.learners.normaliser import normaliser
from coil_rl.learners.reward_scale import RewardScale
from coil_rl.learners.sampling import UNCLIPPED
from coil_rl.learners.state import Stateful
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
    (`LossesOfAgentSteps`). Subclasses override `build_policy`, `build_critic`, `build_loss`,
    `losses`, `parameter_groups` and `learning_rates`.

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
        head: the part of the policy after its memory; all of it without one.
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
        make_actor = partial(
            networks.actor,
            scale=action_scale,
            gain=action_gain,
            squash=squash,
            inputs=self.inputs,
            anchor=anchor,
        )
        self.policy = self.build_policy(env, in_keys, network, make_actor)
        self.critic = self.build_critic(env, in_keys, network)
        memory, self.head = networks.split_memory(self.policy)
        scale = RewardScale(gamma) if scale_rewards else None
        self.extensions = extensions_of(env, in_keys, scale, self.normaliser, auxiliary)

        self.advantage = Advantages(self.critic, gamma, gae_lambda)
        self.loss = self.build_loss(clip, critic)
        self.objective: Callable[[TensorDictBase], TensorDictBase] = self.losses
        if guide_may_act(env):
            self.objective = LossesOfAgentSteps(self.losses, self.loss.loss_critic)

        self.epochs, self.minibatches = epochs, minibatches
        self.sampler = minibatches_of(memory, epochs, minibatches, seed)
        self.gradient = GradientStep(
            self.all_losses,
            self.parameter_groups(),
            [self.policy, self.critic, self.loss],
            self.learning_rates,
            eps=1e-5,
            max_grad_norm=max_grad_norm,
            compile=compile,
            compilable=self.compilable and memory is None and not guide_may_act(env),
        )
        # Losses of a subclass, an extension or a guide that acts have no lean form.
        plain = type(self).losses is PPO.losses and self.objective == self.losses
        self.lean: LeanUpdate | None = None
        if plain and not self.extensions.has_losses:
            self.lean = LeanUpdate.of(
                self.policy, self.critic, self.loss, self.sampler, self.gradient
            )
        self._set_keys(env, in_keys)

    def build_policy(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        network: Mlp,
        make_actor: Callable[..., ProbabilisticTensorDictSequential],
    ) -> ProbabilisticTensorDictSequential:
        """Return the policy; `make_actor` is `networks.actor` with the other arguments set."""
        return make_actor(env, in_keys, network)

    def build_critic(
        self, env: EnvBase, in_keys: Sequence[NestedKey], network: Mlp
    ) -> TensorDictModuleBase:
        """Return the critic."""
        return networks.critic(env, in_keys, network, self.inputs)

    def build_loss(self, clip: float, critic: float) -> LossModule:
        """Return TorchRL's loss of policy and critic; `critic` is the coefficient of the latter."""
        return ClippedLoss(
            self.head,
            self.critic,
            clip_epsilon=clip,
            normalize_advantage=True,
            entropy_bonus=self.entropy(0) > 0,
            entropy_coeff=self.entropy(0),
            critic_coeff=critic,
            loss_critic_type="l2",
            functional=False,
        )

    def _set_keys(self, env: EnvBase, in_keys: Sequence[NestedKey]) -> None:
        """Set the entries that batches and minibatches need."""
        clips = UNCLIPPED in self.policy.out_keys
        self.sample_key = UNCLIPPED if clips else env.action_key
        observed = dict.fromkeys([*in_keys, *self.policy.in_keys])
        read = [*observed, self.sample_key, "action_log_prob", *self.extensions.keys]
        if guide_may_act(env):
            read.append(AGENT_ACTS)
        valued = dict.fromkeys([*in_keys, *self.critic.in_keys])
        after = [*valued, "done", "terminated", env.reward_key]
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
            Means over the minibatches of the losses and of the other values that TorchRL's loss
            reports; the learning rate; and the metrics of the extensions.
        """
        rows, weights = self.prepare(batch, progress), self.loss_weights(progress)
        if self.lean is not None and self.gradient.compile is not True:
            means = self.lean(rows, weights)
        else:
            steps = [self.gradient(minibatch, weights) for minibatch in self.sampler.draw(rows)]
            means = self.gradient.means(steps)
        known = {
            "learning_rate": self.learning_rate(progress),
            "compiled": float(self.gradient.compile is True),
        }
        return means | known | self.extensions.finish(batch, progress)

    def prepare(self, batch: TensorDictBase, progress: float) -> TensorDictBase:
        """Apply the schedules and compute advantages; returns what minibatches are drawn from."""
        self.gradient.begin(progress)
        if self.loss.entropy_bonus:
            self.loss.entropy_coeff.fill_(self.entropy(progress))
        self.extensions.prepare(batch)
        self.advantage(batch)
        rows = self.sampler.rows(batch.select(*self.minibatch_keys))
        # Some losses of TorchRL read the sample of the policy, others `action`.
        return rows.set("action", rows[self.sample_key])

    def loss_weights(self, progress: float) -> dict[str, float]:
        """Return the weights of the losses in the sum that an update minimises."""
        weights = {"loss_objective": 1.0, "loss_critic": 1.0}
        if self.loss.entropy_bonus:
            weights["loss_entropy"] = 1.0
        return self.extensions.weights(weights, progress)

    def all_losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return all losses of a minibatch [N] by name, and other values that are reported."""
        losses = self.objective(minibatch)
        for name, loss in self.extensions.losses(self.head, minibatch).items():
            losses[name] = loss
        return losses

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return TorchRL's losses of a minibatch [N]: `loss_objective`, `loss_critic`, others."""
        return self.loss(minibatch)

    def callbacks(self, cases: Cases) -> Sequence[Callback]:
        """Return the start test of an anchored policy."""
        return start_tests(self.anchor, self.policy, cases)

    def check_batch(self, rows: int, steps: int) -> None:
        """Raise a `ValueError` if a batch [B, T] is too small for the minibatches.

        Args:
            rows: B, of the env. With a memory each minibatch has whole rows.
            steps: T, of each row.
        """
        if isinstance(self.sampler, RowMinibatches):
            self.sampler.check_rows(rows)
        if 2 * self.minibatches > rows * steps:
            raise ValueError(
                f"minibatches={self.minibatches} leaves less than 2 frames to each minibatch, too "
                "few to standardise advantages"
            )
