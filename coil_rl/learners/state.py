"""The state of a learner, which consists of the states of its parts."""

import copy
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch


@runtime_checkable
class HasState(Protocol):
    """An object with a state of its own."""

    def state_dict(self) -> Any:
        """Return the state."""

    def load_state_dict(self, state: Any) -> Any:
        """Restore a state that `state_dict` returned."""


class Stateful:
    """Base class of objects whose saved state is that of the attributes named in `parts`.

    Each is a generator, an object with a state of its own, a plain value, or None, which has an
    empty state.
    """

    parts: ClassVar[tuple[str, ...]]

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next update depends on, besides its batch."""
        return {name: _state_of(vars(self)[name]) for name in self.parts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state that `state_dict` returned."""
        for name in self.parts:
            part = vars(self)[name]
            if isinstance(part, torch.Generator):
                part.set_state(state[name].cpu())
            elif isinstance(part, HasState):
                part.load_state_dict(state[name])
            elif part is not None:
                setattr(self, name, copy.copy(state[name]))


def _state_of(part: Any) -> Any:
    if isinstance(part, torch.Generator):
        return part.get_state()
    if isinstance(part, HasState):
        return part.state_dict()
    return {} if part is None else copy.copy(part)
