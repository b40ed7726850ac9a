"""What every learner has: the base class `Learner`, and what a run calls between its updates."""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor


class Learner(ABC):
    """Base class of learners: a policy, and the update that improves it from a batch of rollouts.

    A subclass has a `policy` and `keys`, and defines `update`, `state_dict` and `load_state_dict`.
    Everything else has a default that does nothing.

    Attributes:
        kind: what the learner trains: "agent" (a policy, from rewards), "imitation" (a policy, from
            a guide's actions) or "guides" (its guides, besides an agent).
        policy: collects the batches; writes the action.
        keys: entries that a batch must have.
        critic: writes `state_value`, the expected return; None: the learner has no such network.
        guides: networks by name that the learner trains besides the policy.
        validates_groups: whether an update validates on groups of samples that it leaves out, such
            as all samples of a track, so that a batch needs more than one group.
    """

    kind: ClassVar[str] = "agent"
    policy: TensorDictModuleBase
    keys: list[NestedKey]
    critic: TensorDictModuleBase | None = None
    guides: Mapping[str, TensorDictModuleBase] = MappingProxyType({})
    validates_groups: bool = False

    @abstractmethod
    def update(self, batch: TensorDictBase, progress: float = 0.0) -> dict[str, float]:
        """Learn from a batch of rollouts.

        Args:
            batch: steps of all rows of an env, [B, T], with `keys`.
            progress: of the run, in [0, 1], for the schedules.

        Returns:
            The metrics of this update by name.
        """

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, besides its batch."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""

    def callbacks(self, cases: "Cases") -> Sequence["Callback"]:
        """Return what a run calls between the updates."""
        return []

    def check_batch(self, rows: int, steps: int) -> None:  # noqa: B027  optional
        """Raise a `ValueError` if batches [B, T] are too small.

        Args:
            rows: B, of the env.
            steps: T, of each row.
        """

    def begin_episodes(self) -> None:  # noqa: B027  optional
        """Forget the running episodes: the next batch is not a continuation of the last one."""

    def export(self, folder: Path) -> None:  # noqa: B027  optional
        """Write what others need besides the policy into the folder of a finished run."""


class Stateful:
    """Base class of objects whose saved state is that of the attributes named in `parts`.

    Each is a generator, an object with a state of its own, a plain value, or None, which has an
    empty state.
    """

    parts: ClassVar[tuple[str, ...]]

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, besides its batch."""
        return {name: _state_of(getattr(self, name)) for name in self.parts}

    def begin_episodes(self) -> None:
        """Tell each part that the running episodes do not go on."""
        for name in self.parts:
            if hasattr(part := getattr(self, name), "begin_episodes"):
                part.begin_episodes()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        for name in self.parts:
            part = getattr(self, name)
            if isinstance(part, torch.Generator):
                part.set_state(state[name].cpu())
            elif hasattr(part, "load_state_dict"):
                part.load_state_dict(state[name])
            elif part is not None:
                setattr(self, name, copy.copy(state[name]))


def _state_of(part: Any) -> Any:
    if isinstance(part, torch.Generator):
        return part.get_state()
    if hasattr(part, "state_dict"):
        return part.state_dict()
    return {} if part is None else copy.copy(part)


class Callback(Protocol):
    """Something that a run calls before the first update and between updates.

    It may take long, as an evaluation does, and it may change the policy.

    Attributes:
        names: of the numbers that `after_update` returns.
    """

    names: Sequence[str]

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether to call `after_update`.

        Args:
            update: number of updates so far; 0: before the first one.
            updates: number of all updates of the run.
            row: metrics of the update; empty before the first one.
        """

    def after_update(self, update: int) -> dict[str, float]:
        """Act after an update, 0 is before the first, and return numbers for the log by name."""


class Cases(Protocol):
    """Cases of a training in which policies are compared: the same new ones for all of them.

    Their steps steer the training, so they are frames of it. A comparison changes neither the
    policy of the learner nor the random numbers of the run.

    Attributes:
        frames: of the whole run.
        steps: that all comparisons have taken so far.
        taken: of these the steps of each policy in the last comparison.
        guide_ahead: whether a guide that is not held was better in every case of the start test.
    """

    frames: int
    steps: int
    taken: list[int]
    guide_ahead: bool

    def teach(self, keys: Sequence[NestedKey], learn: Callable[[TensorDictBase], Any]) -> None:
        """Let something learn from the steps of compared policies.

        Args:
            keys: entries that it needs.
            learn: is called with the steps of each comparison, [rows, T]: the first episode of each
                row, and what followed it.
        """

    def begin(self) -> None:
        """Begin a comparison, which does not depend on those before."""

    def renew(self, count: int) -> None:
        """Draw that many new cases."""

    def compared(
        self, policies: Sequence[TensorDictModuleBase], sampled: Sequence[bool] | None = None
    ) -> list[Tensor]:
        """Return the returns of policies in the present cases, [C] each.

        Args:
            sampled: whether each samples its actions, as in training; None: none does.
        """
