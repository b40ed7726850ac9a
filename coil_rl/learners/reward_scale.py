"""Running scale of rewards, so that the unit of an env's rewards does not matter to a learner.

A critic that learns returns of thousands takes the whole gradient, and one that learns returns of
thousandths learns nothing from it. Only what a learner learns from is divided: logs, curves, tests
and tables have the rewards of the env.
"""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from coil_rl.learners.extension import Extension
from coil_rl.learners.normaliser import ROUNDING, Moments


class RewardScale(Extension):
    """Divides rewards by the standard deviation of the discounted returns so far.

    The return of a step is that of its episode up to it, R = gamma R' + r (Engstrom et al. 2020,
    "Implementation matters in deep policy gradients"). Returns that never differ are divided by
    their size; rewards that are all 0 stay.

    Args:
        gamma: discount.
    """

    def __init__(self, gamma: float) -> None:
        self.gamma, self.moments = gamma, Moments(torch.Size([]))
        self.running: Tensor | None = None  # returns of the running episodes, [B]
        self.given: Tensor | None = None  # rewards of the batch of this update, as they came

    @property
    def scale(self) -> float:
        """What rewards are divided by."""
        size = float(self.moments.size)
        deviation = float(self.moments.variance.sqrt())
        if not size:
            return 1.0
        return deviation if deviation > ROUNDING * size else size

    def learn(self, batch: TensorDictBase) -> None:
        """Add the rewards of a batch of consecutive steps [*B, T] to the statistics."""
        after = batch["next"]
        steps = batch.shape[-1]
        rewards = after["reward"].reshape(-1, steps).cpu().double()
        ended = after["done"].reshape(-1, steps).cpu()
        running = rewards.new_zeros(len(rewards)) if self.running is None else self.running
        returns = torch.empty_like(rewards)
        for step in range(steps):
            running = running * self.gamma + rewards[:, step]
            returns[:, step] = running
            running = running.masked_fill(ended[:, step], 0.0)
        self.running = running
        self.moments.add(returns)

    def learn_episode(self, episode: TensorDictBase) -> None:
        """Add the rewards of an episode [1, T] of another row to the statistics."""
        running, self.running = self.running, None
        self.learn(episode)
        self.running = running

    def scaled(self, rewards: Tensor) -> Tensor:
        """Return rewards of any shape, divided by the scale."""
        return rewards / self.scale

    def prepare(self, batch: TensorDictBase) -> None:
        """Learn from a batch [B, T], and divide its rewards until the end of the update."""
        self.learn(batch)
        self.given = batch["next", "reward"]
        batch["next", "reward"] = self.scaled(self.given)

    def finish(self, batch: TensorDictBase, progress: float) -> dict[str, float]:
        """Put the rewards back, and return what they were divided by, `reward_scale`."""
        if self.given is not None:
            batch["next", "reward"], self.given = self.given, None
        return {"reward_scale": self.scale}

    def begin_episodes(self) -> None:
        """Forget the returns of the running episodes."""
        self.running = None

    def state_dict(self) -> dict[str, Any]:
        """Return the statistics."""
        return {"moments": self.moments.state_dict(), "running": self.running}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        self.moments.load_state_dict(state["moments"])
        self.running = state["running"]
