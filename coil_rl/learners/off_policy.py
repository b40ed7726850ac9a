"""Off-policy learning with a replay buffer, the base class of `DQN` and `SAC`."""

from collections.abc import Sequence
from typing import Any, ClassVar, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.utils import expand_as_right
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule, SoftUpdate

from coil_rl.envs.limits import LARGEST_SEED, check_range
from coil_rl.learners.anchor import Anchor
from coil_rl.learners.gradient import GradientStep
from coil_rl.learners.normaliser import normaliser
from coil_rl.learners.state import Stateful
from coil_rl.schedules import Linear, Schedule, schedule
from coil_rl.transforms.combined_actions import EXECUTED, CombinedAction
from coil_rl.transforms.guide_transform import GuideTransform


class OffPolicy(Stateful):
    """Replay buffer, optimiser, target networks and update.

    A step is stored with the observations before and after it, advice included, because a guide
    with memory or randomness cannot be evaluated again. Where a guide acted in place of the agent,
    the action that was executed is stored, or 0 if the agent's action is a residual. Such steps are
    left out if no action of the agent has the same effect: its actions are choices, or combined in
    several ways. An action that is added to the guide's is stored as the agent's own, since the sum
    is a part of the env.

    A subclass builds its networks and calls `set_loss`. It names the losses to minimise the sum of
    (`minimised`) and the values to report (`reported`). A value out of range is a `ValueError`, and
    so is an env in which the effect or the reward of an action changes over the run.

    Args:
        env: the env, for its device and transforms.
        in_keys: entries that are observed.
        normalise: whether to normalise what is observed, or the entries to normalise, see
            `Normaliser`. Steps are stored as they are.
        tau: step of the target networks towards the networks after each minibatch, as a fraction.
        ratio: how often a step is sampled, on average over the run.
        learning_rate: of Adam, a number or a schedule.
        gamma: discount.
        max_grad_norm: gradients are scaled down to this norm, over all networks together.
        capacity: maximum number of stored steps; the newest replace the oldest.
        batch_size: N, steps in a minibatch.
        starts: number of stored steps before learning starts.
        prior: share of each minibatch that is sampled from the steps of guides, which are then
            stored apart: the symmetric sampling of RLPD (Ball et al. 2023) with 0.5. With 0 all
            steps are sampled alike.
        compile: whether to compile the update, see `GradientStep`.
        anchor: makes the policy start as its guide.
        seed: of the samples.

    Attributes:
        keys: entries that a batch must have.
    """

    kind: ClassVar[str] = "agent"  # as for `PPO`
    compilable: ClassVar[bool] = True
    parts: ClassVar[tuple[str, ...]] = (
        "loss",
        "gradient",
        "generator",
        "pending_updates",
        "normaliser",
        "anchor",
    )
    minimised: tuple[str, ...]
    reported: tuple[str, ...]

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[NestedKey],
        *,
        normalise: bool | Sequence[NestedKey] = False,
        tau: float,
        ratio: float,
        learning_rate: float | Schedule = Linear(1e-3, 0.0),
        gamma: float = 0.99,
        max_grad_norm: float = 10.0,
        capacity: int = 100_000,
        batch_size: int = 256,
        starts: int = 5_000,
        prior: float = 0.0,
        compile: bool | Literal["auto"] = "auto",
        anchor: Anchor | None = None,
        seed: int = 0,
    ) -> None:
        self.anchor, self.compile = anchor, compile
        self.learning_rate = schedule(learning_rate)
        check_range(0, 1, gamma=gamma, tau=tau, prior=prior)
        check_range(0, learning_rate=self.learning_rate(0), starts=starts)
        check_range(0, 10_000, ratio=ratio)
        check_range(0, above=True, max_grad_norm=max_grad_norm)
        check_range(1, batch_size=batch_size)
        if not max(starts, 1) <= capacity:
            raise ValueError(f"capacity={capacity} must be at least 1 and at least starts={starts}")
        check_range(0, LARGEST_SEED, seed=seed)
        for transform in env.modules():
            if isinstance(transform, GuideTransform) and callable(
                getattr(transform, transform.mdp_parameter, None)
            ):
                problem = (
                    f"{transform.mdp_parameter} of {type(transform).__name__} changes over the run"
                )
                effect = "so stored steps would no longer show the effect of an action"
                remedy = "make it a number, or use a learner without replay, such as PPO"
                raise ValueError(f"{problem}, {effect}; {remedy}")
        if (keys := [*env.action_keys, *env.reward_keys]) != ["action", "reward"]:
            needed, has = "one entry action and one entry reward", ", ".join(map(str, keys))
            remedy = "rename them by TorchRL's RenameTransform, or use PPO"
            raise ValueError(
                f"{type(self).__name__} needs {needed}, but this env has {has}; {remedy}"
            )
        self.normaliser = normaliser(env, in_keys, normalise)
        self.gamma, self.tau, self.max_grad_norm = gamma, tau, max_grad_norm
        self.guide_may_act = "agent_acts" in env.observation_spec
        self.of_guide = stored_of_guide(env)
        if prior and self.of_guide == "nothing":
            needed = (
                "steps in which a guide acts in place of the agent, as with the transform Takeover"
            )
            raise ValueError(
                f"prior={prior} needs {needed}, by an action that the agent could choose; or take prior=0"
            )
        after = (*in_keys, "reward", "done", "terminated")
        self.stored_keys: list[NestedKey] = [
            *in_keys,
            "action",
            *(unravel_key(("next", key)) for key in after),
        ]
        self.keys = [*self.stored_keys, "agent_acts"] if self.guide_may_act else [*self.stored_keys]
        self.keys += [("next", EXECUTED)] if self.of_guide == "executed" else []
        self.capacity, self.batch_size, self.ratio, self.starts = (
            capacity,
            batch_size,
            ratio,
            starts,
        )
        self.pending_updates = 0.0
        self.device = env.device or torch.device("cpu")
        self.generator = torch.Generator(self.device).manual_seed(seed)
        # TorchRL's OfflineToOnlineReplayBuffer takes no generator, so a resumed run would draw
        # other samples.
        self.buffer, self.guide_buffer = (
            ReplayBuffer(
                storage=LazyTensorStorage(capacity, device=self.device), generator=self.generator
            )
            for _ in range(2)
        )
        self.prior = round(prior * batch_size)

    def also_store(self, *keys: NestedKey) -> None:
        """Store further entries of the env, before and after each step."""
        for known in (self.stored_keys, self.keys):
            known += [
                each
                for key in keys
                for each in (key, unravel_key(("next", key)))
                if each not in known
            ]

    def set_loss(self, loss: LossModule) -> None:
        """Set TorchRL's loss, and make its target networks and the optimiser."""
        self.loss = loss
        self.loss.make_value_estimator(gamma=self.gamma)
        self.target = SoftUpdate(self.loss, tau=self.tau)
        self.gradient = GradientStep(
            self.losses,
            [list(loss.parameters())],
            [loss],
            lambda progress: [self.learning_rate(progress)],
            eps=1e-8,
            max_grad_norm=self.max_grad_norm,
            after=self.target.step,
            compile=self.compile,
            compilable=self.compilable,
        )

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Store the steps of a batch and learn from stored steps.

        Args:
            batch: [*B, T] with `keys`. A truncated episode is bootstrapped.
            progress: of the run, in [0, 1], for the schedules.

        Returns:
            Means over the minibatches of the `reported` values, 0 before learning starts; the
            number of `minibatches`; the number of stored steps (`kept`); the learning rate; and the
            values of `describe`.
        """
        self.store(batch)
        self.gradient.begin(progress)
        weights, reports, minibatch = self.loss_weights(progress), [], None
        for minibatch in self.samples():
            reports.append(self.gradient(minibatch, weights))
        means = self.gradient.means(reports) if reports else {}
        return {name: means.get(name, 0.0) for name in self.reported} | {
            **self.describe(minibatch),
            "minibatches": float(len(reports)),
            "compiled": float(self.gradient.compile is True),
            "kept": float(self.kept),
            "learning_rate": self.learning_rate(progress),
            **(self.anchor.set_noise(progress) if self.anchor else {}),
        }

    @property
    def kept(self) -> int:
        """Number of stored steps."""
        return len(self.buffer) + len(self.guide_buffer)

    def store(self, batch: TensorDictBase) -> None:
        """Store the steps of a batch [*B, T]."""
        steps, guide = batch.select(*self.stored_keys).reshape(-1), None
        if self.guide_may_act:
            agent = batch["agent_acts"].reshape(-1)
            if self.of_guide == "nothing":
                steps = steps[agent]
            elif self.of_guide == "executed":
                # Where the agent acts it is its own action.
                steps["action"] = batch["next", EXECUTED].reshape(steps["action"].shape)
            else:
                steps["action"] = torch.where(
                    expand_as_right(agent, steps["action"]), steps["action"], 0
                )
            if self.prior:
                steps, guide = steps[agent], steps[~agent]
        for buffer, new in ((self.buffer, steps), (self.guide_buffer, guide)):
            if new is not None and len(new):
                if self.normaliser is not None:
                    self.normaliser.learn(new)
                buffer.extend(new[-self.capacity :])
                self.pending_updates += len(new) * self.ratio / self.batch_size

    def samples(self) -> Sequence[TensorDictBase]:
        """Return as many minibatches [N] as are due for the steps stored so far, with replacement."""
        due = int(self.pending_updates) if self.kept >= self.starts else 0
        if not due:
            return []
        self.pending_updates -= due
        prior = self.prior if len(self.buffer) else self.batch_size
        prior = prior if len(self.guide_buffer) else 0
        sizes = {self.guide_buffer: prior, self.buffer: self.batch_size - prior}
        # All at once: a call of the buffer takes as long as a step.
        parts = [
            buffer.sample(due * size).view(due, size) for buffer, size in sizes.items() if size
        ]
        minibatches: TensorDictBase = torch.cat(parts, 1)
        if self.normaliser is not None:
            minibatches["next"] = self.normaliser(minibatches["next"])
            minibatches = self.normaliser(minibatches)
        return minibatches.unbind(0)

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Return the losses of a minibatch [N] and other values, scalars."""
        return self.loss(minibatch)

    def loss_weights(self, progress: float) -> dict[str, float]:
        """Return the weights of the losses in the sum that an update minimises."""
        return dict.fromkeys(self.minimised, 1.0)

    def describe(self, minibatch: TensorDictBase | None) -> dict[str, float]:
        """Return further metrics of the last minibatch of an update, which is None before learning starts."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next update depends on besides its batch."""
        buffers = [
            {
                "steps": buffer[:].clone().to_dict() if len(buffer) else {},
                "writer": buffer.writer.state_dict(),
            }
            for buffer in (self.buffer, self.guide_buffer)
        ]
        return super().state_dict() | {"buffers": buffers}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict`."""
        super().load_state_dict(state)
        for buffer, stored in zip((self.buffer, self.guide_buffer), state["buffers"], strict=True):
            buffer.empty()
            if stored["steps"]:
                steps = TensorDict.from_dict(
                    stored["steps"], batch_size=stored["steps"]["action"].shape[:1]
                )
                buffer.extend(steps.to(self.device))
            buffer.writer.load_state_dict(stored["writer"])


def stored_of_guide(env: EnvBase) -> Literal["executed", "zero", "nothing"]:
    """Return which action of the agent had the same effect as that of a guide which acted in its place."""
    combined = [transform for transform in env.modules() if isinstance(transform, CombinedAction)]
    if "agent_acts" not in env.observation_spec or (
        len(combined) > 1 and any(each.adds for each in combined)
    ):
        return "nothing"
    executed, own = env.observation_spec.get(EXECUTED, None), env.action_spec
    if executed is None or (executed.shape, executed.dtype) != (own.shape, own.dtype):
        return "nothing"
    return "zero" if any(each.adds for each in combined) else "executed"
