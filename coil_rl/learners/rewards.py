"""Rewards as a learner learns from them: sums of several steps, and in units of their own.

A critic that learns returns of thousands takes the whole gradient, and one that learns returns of
thousandths learns nothing from it. Only what a learner learns from is divided: logs, curves, tests
and tables have the rewards of the env.
"""

from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.utils import expand_as_right
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

    def prepare(self, batch: TensorDictBase) -> None:
        """Learn from a batch [B, T], and divide its rewards until the end of the update."""
        self.learn(batch)
        self.given = batch["next", "reward"]
        batch["next", "reward"] = self.given / self.scale

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


STEPS: NestedKey = ("next", "steps")  # entry [N, 1]: number of steps of a sum of rewards


class NStep:
    """Sums of the rewards of up to n consecutive steps, as if they were one step.

    A sum ends with the episode of its first step. The last n - 1 steps of a batch wait for the next
    batch, unless their episode ends in this one. With n = 1 batches stay as they are.

    Args:
        count: n.
        gamma: discount.
    """

    def __init__(self, count: int, gamma: float) -> None:
        self.count, self.gamma = count, gamma
        self.waiting: TensorDictBase | None = None  # the last steps of each row, [B, n - 1]
        self.given: Tensor | None = None  # which of these have been returned already

    def summed(self, batch: TensorDictBase) -> TensorDictBase:
        """Return the sums [N] that are complete after a batch of consecutive steps [*B, T].

        They have the entries of the batch: those of the first step of the sum, and after `next`
        those of its last step, with the sum as reward and the number of steps as `steps`.
        """
        rows = batch.reshape(-1, batch.shape[-1])
        if self.count == 1:
            return rows.reshape(-1)
        if self.waiting is not None:
            rows = torch.cat([self.waiting.to(rows.device), rows], 1)  # a checkpoint is on the CPU
        after = rows["next"]
        total, done = rows.shape[1], after["done"][..., 0]
        place = torch.arange(total, device=rows.device)
        end = torch.where(done, place, total - 1).flip(1).cummin(1).values.flip(1)
        last = torch.minimum(end, (place + self.count - 1).clamp(max=total - 1))  # of each sum
        sums = after["reward"].clone()
        for step in range(1, self.count):
            shifted = (place + step).clamp(max=total - 1)
            within = (last >= place + step).unsqueeze(-1)
            sums = sums + self.gamma**step * after["reward"][:, shifted] * within
        complete = done.gather(1, last) | (last - place == self.count - 1)
        steps = rows.exclude("next")
        index = torch.arange(len(rows), device=rows.device).unsqueeze(-1)
        steps["next"] = after[index, last].set("reward", sums)
        steps[STEPS] = (last - place + 1).unsqueeze(-1)
        new = complete.clone()
        if self.given is not None:
            new[:, : self.given.shape[1]] &= ~self.given.to(new.device)
        keep = min(self.count - 1, total)
        self.waiting = rows[:, -keep:].clone()
        self.given = complete[:, -keep:]
        return steps[new]

    def begin_episodes(self) -> None:
        """Drop the waiting steps: their episodes do not go on."""
        self.waiting = self.given = None

    def state_dict(self) -> dict[str, Any]:
        """Return the waiting steps."""
        if self.waiting is None:
            return {}
        return {"waiting": self.waiting.clone().to_dict(), "given": self.given}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        self.waiting, self.given = None, state.get("given")
        if self.given is not None:
            self.waiting = TensorDict.from_dict(state["waiting"], batch_size=self.given.shape)


def discounted(minibatch: Any, gamma: Tensor, value: Tensor) -> Tensor:
    """Return the discounted value of the state after each step of a minibatch, shaped as `value`.

    It is 0 after a termination. The state in which an episode was truncated is in no step that
    is learned from: what a network makes of it is a guess, and where the time or a queue grows
    during an episode, the guess and what is learned from it drift without end. So its value is
    limited to one standard deviation from the mean of the others.

    Args:
        gamma: the discount.
        value: of the state after each step, [N] or [N, n].
    """
    done, terminated = (
        expand_as_right(minibatch["next", name].squeeze(-1), value)
        for name in ("done", "terminated")
    )
    others = (~done).sum().clamp(min=1)
    mean = torch.where(done, 0, value).sum() / others
    deviation = (torch.where(done, 0, (value - mean).square()).sum() / others).sqrt()
    limited = value.clamp(mean - deviation, mean + deviation)
    value = torch.where(terminated, 0, torch.where(done, limited, value))
    if STEPS not in minibatch:
        return gamma * value
    return gamma ** expand_as_right(minibatch[STEPS].squeeze(-1), value) * value
