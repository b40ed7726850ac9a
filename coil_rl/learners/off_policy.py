"""Off-policy learning with a replay buffer, the base class of `DQN` and `SAC`."""

import copy
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any, ClassVar, Literal, TypedDict

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase

from coil_rl import output
from coil_rl.learners import networks
from coil_rl.learners.anchor import Anchor, start_tests
from coil_rl.learners.batches import AGENT_ACTS, guide_may_act
from coil_rl.learners.encoders import Mlp, without_memory
from coil_rl.learners.extension import Extension, Extensions
from coil_rl.learners.gradient import GradientStep, Weights, means
from coil_rl.learners.learner import Callback, Cases, Learner, Stateful
from coil_rl.learners.normaliser import RawObservations, normaliser
from coil_rl.learners.policy import Entries, next_of
from coil_rl.learners.rewards import NStep, RewardScale
from coil_rl.ranges import Count, Index, Interval, NonNegative, Positive, Seed, Share, checked
from coil_rl.schedules import Schedule, schedule
from coil_rl.transforms.action_space import nested_key
from coil_rl.transforms.combined_actions import EXECUTED, CombinedAction
from coil_rl.transforms.guide_transform import GuideTransform

UpdatesPerStep = Annotated[float, Interval(ge=0, le=1_000)]
TEST_SHARE = 0.15  # of the frames, for the start test of an anchored policy
AT_ONCE = 100  # minibatches that are sampled by one call, which takes as long as a step


class ReplaySettings(TypedDict, total=False):
    """Arguments that every learner with replay takes as `OffPolicy` does."""

    normalise: bool | Literal["auto"] | Sequence[NestedKey]
    scale_rewards: bool
    n_step: Annotated[int, Interval(ge=1, le=1_000)]
    gamma: Share
    capacity: int
    batch_size: Count
    starts: Index
    prior: Share
    compile: bool | Literal["auto"]
    anchor: Anchor | None
    seed: Seed


@checked
class OffPolicy(Stateful, Learner):
    """Replay buffer, optimiser, target networks and update.

    A step is stored with the observations before and after it, advice included, because a guide
    with memory or randomness cannot be evaluated again. What is stored of a step in which a guide
    acted in place of the agent depends on how actions reach the env:

    | actions of the agent | stored |
    | --- | --- |
    | are executed as they are | the action that was executed |
    | are a residual, added to the guide's | the action 0 |
    | are choices, or combined in several ways | nothing: no action of the agent has this effect |

    Where the agent acts its own action is stored, also a residual, because the sum is a part of the
    env.

    A subclass builds its networks, perhaps with a target (`follow`), calls `set_update` and defines
    `losses`. It names the losses to minimise the sum of (`minimised`) and the values to report
    (`reported`). A value out of range is a `ValueError`, and so is an env in which the effect or
    the reward of an action changes over the run.

    Args:
        env: the env, for its device and transforms.
        in_keys: entries that are observed.
        network: architecture of the networks; one with a memory is a `ValueError`.
        normalise: whether to normalise what is observed, or the entries to normalise, see
            `Normaliser`; with "auto" the steps before learning starts decide. Steps are stored as
            they are.
        scale_rewards: whether rewards are divided by the running deviation of returns, see
            `RewardScale`.
        tau: step of the target networks towards the networks after each minibatch, as a fraction.
        updates_per_step: minibatches for each step that is stored once learning has started (the
            UTD ratio of the literature).
        n_step: number of consecutive steps whose rewards are summed before the value of the next
            state is added, see `NStep`.
        learning_rate: of Adam, a number or a schedule.
        gamma: discount.
        max_grad_norm: gradients are scaled down to this norm, over all networks together; None:
            they stay as they are.
        capacity: maximum number of stored steps; the newest replace the oldest.
        batch_size: N, steps in a minibatch.
        starts: number of stored steps before learning starts.
        prior: share of each minibatch that is sampled from the steps of guides, which are then
            stored apart: the symmetric sampling of RLPD (Ball et al. 2023) with 0.5. With 0 all
            steps are sampled alike.
        compile: whether to compile the update, see `GradientStep`.
        anchor: makes the policy start as its guide.
        auxiliary: extensions, such as losses of the policy (`KickstartLoss`).
        seed: of the samples.

    Attributes:
        target: a copy of the network that rates actions, which follows it slowly; None: there is
            none.
        keys: entries that a batch must have.
        extensions: what is added to the algorithm.
    """

    compilable: ClassVar[bool] = True
    parts: ClassVar[tuple[str, ...]] = (
        "policy",
        "target",
        "gradient",
        "generator",
        "pending_updates",
        "sums",
        "normaliser",
        "reward_scale",
        "extensions",
    )
    minimised: tuple[str, ...]
    reported: tuple[str, ...] = ()
    target: Any = None

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        network: Mlp,
        *,
        normalise: bool | Literal["auto"] | Sequence[NestedKey] = False,
        scale_rewards: bool = False,
        tau: Share,
        updates_per_step: UpdatesPerStep,
        n_step: Annotated[int, Interval(ge=1, le=1_000)] = 1,
        learning_rate: NonNegative | Schedule,
        gamma: Share = 0.99,
        max_grad_norm: Positive | None,
        capacity: int = 1_000_000,
        batch_size: Count = 256,
        starts: Index = 500,
        prior: Share = 0.0,
        compile: bool | Literal["auto"] = "auto",
        anchor: Anchor | None = None,
        auxiliary: Sequence[Extension] = (),
        seed: Seed = 0,
    ) -> None:
        self.anchor, self.compile = anchor, compile
        self.in_keys = in_keys = [nested_key(key) for key in in_keys]
        self.network = without_memory(network, type(self).__name__)
        self.learning_rate = schedule(learning_rate)
        if not max(starts, 1) <= capacity:
            raise ValueError(f"capacity={capacity} must be at least 1 and at least starts={starts}")
        check_replay(env, type(self).__name__)
        self.normaliser = normaliser(env, in_keys, normalise, enough=max(starts, 1))
        self.reward_scale = RewardScale(gamma) if scale_rewards else None
        self.inputs = networks.inputs_of(env, self.normaliser, anchor)
        self.max_grad_norm = max_grad_norm
        self.sums = NStep(n_step, gamma)
        self.guide_may_act = guide_may_act(env)
        self.of_guide = stored_of_guide(env)
        if prior and self.of_guide == "nothing":
            raise ValueError(
                f"prior={prior} needs steps in which a guide acts in place of the agent, as with "
                "the transform Takeover, by an action that the agent could choose; or take prior=0"
            )
        after = (*in_keys, "reward", "done", "terminated")
        self.stored_keys: list[NestedKey] = [
            *in_keys,
            "action",
            *(unravel_key(("next", key)) for key in after),
        ]
        self.keys = [*self.stored_keys]
        if self.guide_may_act:
            self.keys.append(AGENT_ACTS)
        if self.of_guide == "executed":
            self.keys.append(("next", EXECUTED))
        if anchor is not None:
            self.also_store(anchor.advice_key)
        self.capacity, self.batch_size = capacity, batch_size
        self.updates_per_step, self.starts = updates_per_step, starts
        self.pending_updates = 0.0
        self.device = env.device or torch.device("cpu")
        # Tensors, so that one compiled update serves all values.
        self.gamma, self.tau = torch.tensor([gamma, tau], device=self.device).unbind(0)
        self.generator = torch.Generator(self.device).manual_seed(seed)
        self.buffer, self.guide_buffer = self._new_buffer(), self._new_buffer()
        self.prior = round(prior * batch_size)
        self.extensions = Extensions([*auxiliary, RawObservations(env, in_keys, self.normaliser)])
        self.also_store(*self.extensions.keys)
        self.reported = (*self.reported, *self.extensions.weights({}, 0.0))

    def _new_buffer(self) -> ReplayBuffer:
        # TorchRL's OfflineToOnlineReplayBuffer takes no generator, so a resumed run would draw
        # other samples.
        storage = LazyTensorStorage(self.capacity, device=self.device)
        return ReplayBuffer(storage=storage, generator=self.generator)

    def also_store(self, *keys: NestedKey) -> None:
        """Store further entries of the env, before and after each step."""
        for key in keys:
            for each in (key, unravel_key(("next", key))):
                for known in (self.stored_keys, self.keys):
                    if each not in known:
                        known.append(each)

    def follow(self, network: nn.Module, weights: Weights) -> None:
        """Make the target of a network with these weights."""
        self.target = copy.deepcopy(network).requires_grad_(False)
        self.of_target, self.followed = Weights(self.target), weights

    def set_update(
        self, parameters: Sequence[nn.Parameter], reads: Sequence[Tensor], **options: Any
    ) -> None:
        """Make the optimiser.

        Args:
            parameters: that it changes.
            reads: other tensors that `losses` reads, besides those of the target.
            options: further ones of `GradientStep`.
        """
        known = [self.gamma, self.tau, *reads]
        if self.target is not None:
            known += [self.of_target.vector, *self.target.buffers()]
        self.gradient = GradientStep(
            self.losses,
            [parameters],
            known,
            lambda progress: [self.learning_rate(progress)],
            eps=1e-8,
            max_grad_norm=self.max_grad_norm,
            after=self.after_update,
            compile=self.compile,
            compilable=self.compilable,
            **options,
        )

    @torch.no_grad()
    def after_update(self) -> None:
        """Move the target, after each minibatch."""
        if self.target is not None:
            self.of_target.vector.lerp_(self.followed.vector, self.tau)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Store the steps of a batch and learn from stored steps.

        Args:
            batch: [*B, T] with `keys`. A truncated episode is bootstrapped, see `discounted`.
            progress: of the run, in [0, 1], for the schedules.

        Returns:
            Means over the minibatches of the `reported` values, NaN without any, as before learning
            starts; the number of `minibatches`; the number of stored steps (`kept`); the learning
            rate; the values of `describe`; and the metrics of the extensions.
        """
        self.store(batch)
        self.gradient.begin(progress)
        weights, reports, minibatch = self.loss_weights(progress), [], None
        minibatches: Iterable[Entries] = self.samples()
        due = int(self.pending_updates)
        if due > AT_ONCE:  # to make a bar takes as long as a small minibatch
            minibatches = output.progress(
                iterable=minibatches,
                total=due,
                unit="minibatch",
                desc="learn",
                leave=False,
                delay=2.0,
            )
        for minibatch in minibatches:
            reports.append(self.gradient(minibatch, weights))
        found = means(reports)
        metrics = {name: found.get(name, math.nan) for name in self.reported}
        metrics |= self.describe(minibatch) | {
            "minibatches": float(len(reports)),
            "compiled": float(self.gradient.compile is True),
            "kept": float(self.kept),
            "learning_rate": self.learning_rate(progress),
        }
        if self.reward_scale is not None:
            metrics |= self.reward_scale.finish(batch, progress)
        return metrics | self.extensions.finish(batch, progress)

    @property
    def kept(self) -> int:
        """Number of stored steps."""
        return len(self.buffer) + len(self.guide_buffer)

    def store(self, batch: TensorDictBase) -> None:
        """Store the steps of a batch [*B, T], with the rewards as they are."""
        if self.reward_scale is not None:
            self.reward_scale.learn(batch)
        entries = [*self.stored_keys, *([AGENT_ACTS] if self.guide_may_act else [])]
        steps = batch.select(*entries)
        if self.guide_may_act and self.of_guide != "nothing":
            acts = expand_as_right(batch[AGENT_ACTS].squeeze(-1), steps["action"])
            of_guide: Tensor | float = 0.0
            if self.of_guide == "executed":
                of_guide = batch["next", EXECUTED].reshape(steps["action"].shape)
            steps["action"] = torch.where(acts, steps["action"], of_guide)
        steps = self.sums.summed(steps)
        if not self.guide_may_act:
            self._store(steps, self.buffer)
            return
        agent_acts = steps.pop(AGENT_ACTS).reshape(-1)
        if self.prior:
            self._store(steps[agent_acts], self.buffer)
            self._store(steps[~agent_acts], self.guide_buffer)
        else:
            self._store(steps if self.of_guide != "nothing" else steps[agent_acts], self.buffer)

    def _store(self, steps: TensorDictBase, buffer: ReplayBuffer) -> None:
        if len(steps) == 0:
            return
        if self.normaliser is not None:
            self.normaliser.learn(steps)
        buffer.extend(steps[-self.capacity :])
        if self.kept >= self.starts:
            self.pending_updates += len(steps) * self.updates_per_step

    def samples(self) -> Iterator[Entries]:
        """Yield as many minibatches [N] as are due for the steps stored so far."""
        due = int(self.pending_updates)
        self.pending_updates -= due
        while due:
            count = min(due, AT_ONCE)
            due -= count
            yield from self._sampled(count)

    def _sampled(self, count: int) -> Iterator[Entries]:
        """Yield some minibatches."""
        prior = self.prior
        if not len(self.guide_buffer):
            prior = 0
        elif not len(self.buffer):
            prior = self.batch_size
        sizes = {self.guide_buffer: prior, self.buffer: self.batch_size - prior}
        parts = [
            buffer.sample(count * size).view(count, size) for buffer, size in sizes.items() if size
        ]
        drawn: TensorDictBase = torch.cat(parts, 1) if len(parts) > 1 else parts[0]
        entries = Entries(drawn.items(True, True))
        reward = ("next", "reward")
        if self.reward_scale is not None:
            entries[reward] = entries[reward] / self.reward_scale.scale
        if self.inputs is not None:
            after = self.inputs(next_of(entries))
            entries = self.inputs(entries)
            entries |= {unravel_key(("next", key)): value for key, value in after.items()}
        columns = {key: value.unbind(0) for key, value in entries.items()}
        for each in range(count):
            yield Entries({key: column[each] for key, column in columns.items()})

    def losses(self, minibatch: Entries) -> dict[str, Tensor]:
        """Return the losses of a minibatch [N] by name, and other values, scalars."""
        raise NotImplementedError

    def loss_weights(self, progress: float) -> dict[str, float]:
        """Return the weights of the losses in the sum that an update minimises."""
        return self.extensions.weights(dict.fromkeys(self.minimised, 1.0), progress)

    def callbacks(self, cases: Cases) -> Sequence[Callback]:
        """Return the start test of an anchored policy, from whose steps is learned too."""
        tests = start_tests(self.anchor, self.policy, cases, share=TEST_SHARE)
        if tests and not self.guide_may_act:
            cases.teach(self.stored_keys, self.store_episodes)
        return tests

    def store_episodes(self, episodes: TensorDictBase) -> None:
        """Store the steps of the first episode of each row, [rows, T]."""
        done = episodes["next", "done"].reshape(episodes.shape)
        within = done.cumsum(-1) - done.int() == 0
        for row, live in zip(episodes, within, strict=True):
            steps = row[live].unsqueeze(0)
            if self.reward_scale is not None:
                self.reward_scale.learn_episode(steps)
            self._store(NStep(self.sums.count, self.sums.gamma).summed(steps), self.buffer)

    def describe(self, minibatch: Entries | None) -> dict[str, float]:
        """Return further metrics of the last minibatch, which is None if there is none."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next update depends on besides its batch."""
        buffers = []
        for buffer in (self.buffer, self.guide_buffer):
            steps = buffer[:].clone().to_dict() if len(buffer) else {}
            buffers.append({"steps": steps, "writer": buffer.writer.state_dict()})
        return super().state_dict() | {"buffers": buffers}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict`."""
        super().load_state_dict(state)
        for buffer, stored in zip((self.buffer, self.guide_buffer), state["buffers"], strict=True):
            buffer.empty()
            if entries := stored["steps"]:
                steps = TensorDict.from_dict(entries, batch_size=entries["action"].shape[:1])
                buffer.extend(steps.to(self.device))
            buffer.writer.load_state_dict(stored["writer"])


def check_replay(env: EnvBase, learner: str) -> None:
    """Raise a `ValueError` if a learner with replay, of that name, cannot learn in an env."""
    for transform in env.modules():
        if not isinstance(transform, GuideTransform):
            continue
        name = transform.mdp_parameter
        if callable(getattr(transform, name, None)):
            raise ValueError(
                f"{name} of {type(transform).__name__} changes over the run, so stored steps would "
                "no longer show the effect of an action; make it a number, or use a learner "
                "without replay, such as PPO"
            )
    if (keys := [*env.action_keys, *env.reward_keys]) != ["action", "reward"]:
        raise ValueError(
            f"{learner} needs one entry action and one entry reward, but this env has "
            f"{', '.join(map(str, keys))}; rename them by TorchRL's RenameTransform, or use PPO"
        )


def stored_of_guide(env: EnvBase) -> Literal["executed", "zero", "nothing"]:
    """Return which action of the agent has the same effect as that of a guide in its place."""
    combined = [transform for transform in env.modules() if isinstance(transform, CombinedAction)]
    adds = any(each.adds for each in combined)
    if not guide_may_act(env) or (len(combined) > 1 and adds):
        return "nothing"
    executed, own = env.observation_spec.get(EXECUTED, None), env.action_spec
    if executed is None or (executed.shape, executed.dtype) != (own.shape, own.dtype):
        return "nothing"
    return "zero" if adds else "executed"
