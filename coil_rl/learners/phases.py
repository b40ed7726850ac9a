"""Whose turn it is to learn: the phases of Dynamic COIL (paper section 3.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import torch

ORDERS = ("alternate", "joint", "agent", "guide")
CHOICES = ("sequential", "stochastic")


@dataclass(frozen=True)
class Turn:
    """Who learns in a phase.

    Attributes:
        agent: whether the agent does.
        guides: which guides do.
        earlier: how many phases of this kind there were before.
    """

    agent: bool
    guides: tuple[int, ...]
    earlier: int


class Ending(Protocol):
    """When a phase has gone on for long enough."""

    def __call__(self, frames: int, rewards: Sequence[float]) -> bool:
        """Whether it ends, given its frames so far and the mean reward of a step in each of its updates."""


class AfterFrames:
    """A phase of fixed length; it ends with the update that completes it.

    Args:
        frames: how many.

    Raises:
        ValueError: if that is less than one.
    """

    def __init__(self, frames: int) -> None:
        if frames < 1:
            raise ValueError(f"frames={frames} must be at least 1")
        self.frames = frames

    def __call__(self, frames: int, rewards: Sequence[float]) -> bool:
        """Whether there were as many."""
        return frames >= self.frames


class AtConvergence:
    """A phase ends when several evaluations on end have not improved on the best before them.

    An evaluation is the mean reward of a step in the batch of one update.

    Args:
        evaluations: how many in a row.
        improvement: by how much the mean reward must be better to count.
        frames: after which the phase ends in any case; None: never.

    Raises:
        ValueError: if there are no evaluations or frames, or the improvement is negative.
    """

    def __init__(self, evaluations: int = 5, improvement: float = 0.0, frames: int | None = None) -> None:
        if evaluations < 1:
            raise ValueError(f"evaluations={evaluations} must be at least 1")
        if not improvement >= 0:
            raise ValueError(f"improvement={improvement} must be at least 0")
        if frames is not None and frames < 1:
            raise ValueError(f"frames={frames} must be at least 1, or null")
        self.evaluations, self.improvement, self.frames = evaluations, improvement, frames

    def __call__(self, frames: int, rewards: Sequence[float]) -> bool:
        """Whether the reward has stopped growing, or the frames are used up."""
        if self.frames is not None and frames >= self.frames:
            return True
        best, since = float("-inf"), 0
        for reward in rewards:
            best, since = (reward, 0) if reward > best + self.improvement else (best, since + 1)
        return since >= self.evaluations


class Phases:
    """Who learns now, and when the next one's turn comes.

    Args:
        guides: n, how many there are.
        order: "alternate": the agent, a guide, the agent, a guide and so on. As controls, "joint": everybody at once;
            "agent": the agent alone; "guide": one guide after the other, and never the agent.
        choice: of the guide that learns in the i-th guide phase: "sequential": i mod n; "stochastic": uniform.
        agent_phase: when a phase in which the agent learns ends.
        guide_phase: when one in which only a guide learns ends.
        seed: of the stochastic choice.

    Attributes:
        turn: who learns now.
        number: of the phase, from 0.

    Raises:
        ValueError: for an order or a choice that does not exist, or without a guide.

    Example:
        >>> phases = Phases(2, agent_phase=AfterFrames(100), guide_phase=AfterFrames(50))
        >>> [(phases.turn.agent, phases.turn.guides) for _ in range(7) if phases.advance(50, reward=1.0) or True]
        [(True, ()), (False, (0,)), (True, ()), (True, ()), (False, (1,)), (True, ()), (True, ())]
    """

    def __init__(
        self,
        guides: int,
        *,
        order: Literal["alternate", "joint", "agent", "guide"] = "alternate",
        choice: Literal["sequential", "stochastic"] = "sequential",
        agent_phase: Ending | None = None,
        guide_phase: Ending | None = None,
        seed: int = 0,
    ) -> None:
        if order not in ORDERS or choice not in CHOICES:
            raise ValueError(f"order={order!r} and choice={choice!r} must be one of {ORDERS} and of {CHOICES}")
        if guides < 1:
            raise ValueError(f"guides={guides} must be at least 1")
        self.guides, self.order, self.choice = guides, order, choice
        self.endings = {True: agent_phase or AfterFrames(131_072), False: guide_phase or AfterFrames(65_536)}
        self.generator = torch.Generator().manual_seed(seed)
        self.number, self.frames = 0, 0
        self.rewards: list[float] = []
        self.turn = self._next()

    def advance(self, frames: int, reward: float) -> bool:
        """Count an update; returns whether it was the last of its phase.

        Args:
            frames: in its batch.
            reward: mean of a step in it.
        """
        self.frames += frames
        self.rewards.append(reward)
        if not self.endings[self.turn.agent](self.frames, self.rewards):
            return False
        self.number, self.frames, self.rewards = self.number + 1, 0, []
        self.turn = self._next()
        return True

    def _next(self) -> Turn:
        if self.order in ("agent", "joint"):
            everybody = range(self.guides) if self.order == "joint" else ()
            return Turn(True, tuple(everybody), self.number)
        earlier = self.number if self.order == "guide" else self.number // 2
        if self.order == "alternate" and self.number % 2 == 0:
            return Turn(True, (), earlier)
        if self.choice == "sequential":
            return Turn(False, (earlier % self.guides,), earlier)
        return Turn(False, (int(torch.randint(self.guides, (), generator=self.generator)),), earlier)

    def state_dict(self) -> dict[str, Any]:
        """Where the phases stand."""
        return {
            "number": self.number,
            "frames": self.frames,
            "rewards": list(self.rewards),
            "turn": (self.turn.agent, list(self.turn.guides), self.turn.earlier),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a state of `state_dict`."""
        agent, guides, earlier = state["turn"]
        self.turn = Turn(agent, tuple(guides), earlier)
        self.number, self.frames, self.rewards = state["number"], state["frames"], list(state["rewards"])
        self.generator.set_state(state["generator"])
