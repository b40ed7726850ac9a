"""Off-policy learning with a replay buffer, the base class of `DQN` and `SAC`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule, SoftUpdate

from coil_rl.envs.limits import LARGEST_SEED, check_range
from coil_rl.learners.normaliser import normaliser
from coil_rl.schedules import Linear, Schedule, schedule
from coil_rl.transforms.guide_transform import GuideTransform


class OffPolicy:
    """Replay buffer, optimiser, target networks and update.

    A step is stored with the observations before and after it, advice included, because a guide with memory or
    randomness cannot be evaluated again. A step in which a guide acted is left out: its `action` was not executed.

    A subclass builds its networks and calls `set_loss`. It names the losses to minimise the sum of (`minimised`) and
    the values to report (`reported`).

    Args:
        env: the env, for its device and transforms.
        in_keys: entries that are observed.
        normalise: whether to normalise what is observed, or the entries to normalise, see `Normaliser`. Steps are
            stored as they are.
        tau: step of the target networks towards the networks after each minibatch, as a fraction.
        ratio: how often a step is sampled, on average over the run.
        learning_rate: of Adam, a number or a schedule.
        gamma: discount.
        max_grad_norm: gradients are scaled down to this norm, over all networks together.
        capacity: maximum number of stored steps; the newest replace the oldest.
        batch_size: N, steps in a minibatch.
        starts: number of stored steps before learning starts.
        seed: of the samples.

    Attributes:
        kind: as for `PPO`.
        keys: entries that a batch must have.

    Raises:
        ValueError: for a value out of range, or if the effect or the reward of an action changes over the run.
    """

    kind: ClassVar[str] = "agent"
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
        seed: int = 0,
    ) -> None:
        self.learning_rate = schedule(learning_rate)
        check_range(0, 1, gamma=gamma, tau=tau)
        check_range(0, learning_rate=self.learning_rate(0), starts=starts)
        check_range(0, 10_000, ratio=ratio)
        check_range(0, above=True, max_grad_norm=max_grad_norm)
        check_range(1, batch_size=batch_size)
        if not max(starts, 1) <= capacity:
            raise ValueError(f"capacity={capacity} must be at least 1 and at least starts={starts}")
        check_range(0, LARGEST_SEED, seed=seed)
        for transform in env.modules():
            if isinstance(transform, GuideTransform) and callable(getattr(transform, transform.mdp_parameter, None)):
                raise ValueError(
                    f"{transform.mdp_parameter} of {type(transform).__name__} changes over the run, so stored steps "
                    "would no longer show the effect of an action; make it a number, or use a learner without replay, "
                    "such as PPO"
                )
        if (keys := [*env.action_keys, *env.reward_keys]) != ["action", "reward"]:
            raise ValueError(
                f"{type(self).__name__} needs one entry action and one entry reward, but this env has "
                f"{', '.join(map(str, keys))}; rename them by TorchRL's RenameTransform, or use PPO"
            )
        self.normaliser = normaliser(env, in_keys, normalise)
        self.gamma, self.tau, self.max_grad_norm = gamma, tau, max_grad_norm
        self.guide_may_act = "agent_acts" in env.observation_spec
        after = (*in_keys, "reward", "done", "terminated")
        self.stored_keys: list[NestedKey] = [*in_keys, "action", *(unravel_key(("next", key)) for key in after)]
        self.keys = [*self.stored_keys, "agent_acts"] if self.guide_may_act else self.stored_keys
        self.capacity, self.batch_size, self.ratio, self.starts = capacity, batch_size, ratio, starts
        self.pending_updates = 0.0
        self.device = env.device or torch.device("cpu")
        self.generator = torch.Generator(self.device).manual_seed(seed)
        storage = LazyTensorStorage(capacity, device=self.device)
        self.buffer = ReplayBuffer(storage=storage, batch_size=batch_size, generator=self.generator)

    def set_loss(self, loss: LossModule) -> None:
        """Set TorchRL's loss, and make its target networks and the optimiser."""
        self.loss = loss
        self.loss.make_value_estimator(gamma=self.gamma)
        self.target = SoftUpdate(self.loss, tau=self.tau)
        self.parameters = list(self.loss.parameters())
        self.optimiser = torch.optim.Adam(self.parameters, lr=self.learning_rate(0), fused=True)

    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Store the steps of a batch and learn from stored steps.

        Args:
            batch: [*B, T] with `keys`. A truncated episode is bootstrapped.
            progress: of the run, in [0, 1], for the schedules.

        Returns:
            Means over the minibatches of the `reported` values, 0 before learning starts; the number of `minibatches`;
            the number of stored steps (`kept`); the learning rate; and the values of `describe`.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate(progress)
        self.store(batch)
        reports, minibatch = [], None
        for minibatch in self.samples():
            reports.append(self.step(minibatch))
        means = {
            name: float(torch.stack([report[name] for report in reports]).mean()) if reports else 0.0
            for name in self.reported
        }
        return means | {
            **self.describe(minibatch),
            "minibatches": float(len(reports)),
            "kept": float(len(self.buffer)),
            "learning_rate": self.learning_rate(progress),
        }

    def store(self, batch: TensorDictBase) -> None:
        """Store the steps of a batch [*B, T]."""
        steps = batch.select(*self.stored_keys).reshape(-1)
        if self.guide_may_act:
            steps = steps[batch["agent_acts"].reshape(-1)]
        if len(steps):
            if self.normaliser is not None:
                self.normaliser.learn(steps)
            self.buffer.extend(steps[-self.capacity :])
        self.pending_updates += len(steps) * self.ratio / self.batch_size

    def samples(self) -> Iterator[TensorDictBase]:
        """Yield as many minibatches [N] as are due for the steps stored so far, with replacement."""
        while self.pending_updates >= 1 and len(self.buffer) >= self.starts:
            self.pending_updates -= 1
            minibatch = self.buffer.sample()
            if self.normaliser is not None:
                minibatch["next"] = self.normaliser(minibatch["next"])
                minibatch = self.normaliser(minibatch)
            yield minibatch

    def step(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Take one step of the optimiser; returns the values of TorchRL's loss."""
        losses = self.loss(minibatch)
        for parameter in self.parameters:  # as `zero_grad`, in less time
            parameter.grad = None
        sum(losses[name] for name in self.minimised).backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
        self.optimiser.step()
        self.target.step()
        detached: TensorDictBase = losses.detach()
        return detached

    def describe(self, minibatch: TensorDictBase | None) -> dict[str, float]:
        """Return further metrics of the last minibatch of an update, which is None before learning starts."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next update depends on besides its batch."""
        return {
            "loss": self.loss.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "steps": self.buffer[:].clone().to_dict() if len(self.buffer) else {},
            "writer": self.buffer.writer.state_dict(),
            "generator": self.generator.get_state(),
            "pending_updates": self.pending_updates,
            "normaliser": {} if self.normaliser is None else self.normaliser.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state from `state_dict`."""
        self.loss.load_state_dict(state["loss"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.buffer.empty()
        if state["steps"]:
            steps = TensorDict.from_dict(state["steps"], batch_size=state["steps"]["action"].shape[:1])
            self.buffer.extend(steps.to(self.device))
        self.buffer.writer.load_state_dict(state["writer"])
        self.generator.set_state(state["generator"].cpu())
        self.pending_updates = state["pending_updates"]
        if self.normaliser is not None:
            self.normaliser.load_state_dict(state["normaliser"])
