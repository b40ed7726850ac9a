"""Rewards of several steps in place of one, for learners with replay."""

from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor

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
        total = rows.shape[1]
        place = torch.arange(total, device=rows.device)
        last, sums = self._last(after["done"][..., 0]), after["reward"].clone()
        for step in range(1, self.count):
            shifted = (place + step).clamp(max=total - 1)
            within = (last >= place + step).unsqueeze(-1)
            sums = sums + self.gamma**step * after["reward"][:, shifted] * within
        ended = after["done"][..., 0].gather(1, last)
        complete = ended | (last - place == self.count - 1)
        steps = rows.exclude("next")
        index = torch.arange(len(rows), device=rows.device).unsqueeze(-1)
        steps["next"] = after[index, last].set("reward", sums)
        steps[STEPS] = (last - place + 1).unsqueeze(-1)
        return steps[self._keep(rows, complete)]

    def _last(self, done: Tensor) -> Tensor:
        """Return the place of the last step of each sum, [B, T], from the ends of episodes."""
        total = done.shape[1]
        place = torch.arange(total, device=done.device).expand_as(done)
        end = torch.where(done, place, total - 1).flip(1).cummin(1).values.flip(1)
        return torch.minimum(end, (place + self.count - 1).clamp(max=total - 1))

    def _keep(self, rows: TensorDictBase, complete: Tensor) -> Tensor:
        """Keep the last steps for the next batch; return which steps are complete and new."""
        new = complete.clone()
        if self.given is not None:
            new[:, : self.given.shape[1]] &= ~self.given.to(new.device)
        keep = min(self.count - 1, rows.shape[1])
        self.waiting = rows[:, -keep:].clone()
        self.given = complete[:, -keep:]
        return new

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
