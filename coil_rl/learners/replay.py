"""Steps of the past, from which an off-policy learner draws at random."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import EnvBase

from coil_rl.learners.limits import check_numbers
from coil_rl.transforms.guide_transform import GuideTransform

AFTER = ("reward", "done", "terminated")


class Replay:
    """Keeps the newest steps, and draws minibatches of them with the same chance for each.

    A step is kept with what was observed before and after it, advice included: a guide may have a memory or draw, so
    that it could not be asked again later. A step in which a guide acted instead of the agent is left out, because its
    `action` is not the one that led to what came after.

    Args:
        env: whether a guide acts in some of the steps, which it then says by `agent_acts`; and the device.
        in_keys: what is observed.
        capacity: steps that are kept; a new one takes the place of the oldest.
        batch_size: N, steps of a minibatch.
        ratio: how often a step is drawn, on average over the run.
        starts: nothing is drawn before so many steps are kept.
        seed: of the draws.

    Attributes:
        keys: what a batch must hold.

    Raises:
        ValueError: for numbers out of range, and if what an action leads to or pays changes over the run, as old steps
            would then say what is no longer so.

    Example:
        >>> from coil_rl.envs import ConeTrackEnv, shipped_tracks
        >>> env = ConeTrackEnv(shipped_tracks("train"), num_cars=8)
        >>> replay = Replay(env, ["observation"], batch_size=16, ratio=2, starts=0)
        >>> replay.add(env.rollout(10))
        >>> [tuple(minibatch.shape) for minibatch in replay.draws()]
        [(16,), (16,), (16,), (16,), (16,), (16,), (16,), (16,), (16,), (16,)]
    """

    def __init__(
        self,
        env: EnvBase,
        in_keys: Sequence[str] = ("observation",),
        *,
        capacity: int = 100_000,
        batch_size: int = 256,
        ratio: float = 8.0,
        starts: int = 1_000,
        seed: int = 0,
    ) -> None:
        check_numbers(1, batch_size=batch_size)
        if not max(starts, 1) <= capacity:
            raise ValueError(f"capacity={capacity} must be at least 1 and at least starts={starts}")
        check_numbers(0, 10_000, ratio=ratio)
        check_numbers(0, capacity, starts=starts)
        check_numbers(0, 2**63 - 1, seed=seed)
        for transform in env.modules():
            if isinstance(transform, GuideTransform) and callable(getattr(transform, transform.mdp_parameter, None)):
                raise ValueError(
                    f"{transform.mdp_parameter} of {type(transform).__name__} changes over the run, and with it what "
                    "an action leads to, so that steps of the past would mislead; make it a number, or take a learner "
                    "without replay, such as PPO"
                )
        self.shared = "agent_acts" in env.observation_spec
        self.kept: list[NestedKey] = [*in_keys, "action", *(("next", key) for key in (*in_keys, *AFTER))]
        self.keys: list[NestedKey] = [*self.kept, "agent_acts"] if self.shared else self.kept
        self.ratio, self.starts, self.owed = ratio, starts, 0.0
        self.capacity, self.batch_size, self.device = capacity, batch_size, env.device or torch.device("cpu")
        self.generator = torch.Generator(self.device).manual_seed(seed)
        storage = LazyTensorStorage(capacity, device=self.device)
        self.buffer = ReplayBuffer(storage=storage, batch_size=batch_size, generator=self.generator)

    def __len__(self) -> int:
        """Steps that are kept."""
        return len(self.buffer)

    def add(self, batch: TensorDictBase) -> None:
        """Keep the steps of a batch [*B, T] with `keys`."""
        steps = batch.select(*self.kept).reshape(-1)
        if self.shared:
            steps = steps[batch["agent_acts"].reshape(-1)]
        if len(steps):
            self.buffer.extend(steps[-self.capacity :])
        self.owed += len(steps) * self.ratio / self.batch_size

    def draws(self) -> Iterator[TensorDictBase]:
        """As many minibatches [N] as the steps added since the last call are due, with replacement."""
        while self.owed >= 1 and len(self) >= self.starts:
            self.owed -= 1
            yield self.buffer.sample()

    def state_dict(self) -> dict[str, Any]:
        """The steps that are kept, where the next one goes, and what will be drawn."""
        steps = self.buffer[:].clone().to_dict() if len(self) else {}
        return {
            "steps": steps,
            "writer": self.buffer.writer.state_dict(),
            "generator": self.generator.get_state(),
            "owed": self.owed,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over a state of `state_dict`."""
        self.buffer.empty()
        if state["steps"]:
            steps = TensorDict.from_dict(state["steps"], batch_size=state["steps"]["action"].shape[:1])
            self.buffer.extend(steps.to(self.device))
        self.buffer.writer.load_state_dict(state["writer"])
        self.generator.set_state(state["generator"].cpu())
        self.owed = state["owed"]
