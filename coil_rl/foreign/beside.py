"""Controllers beside one env, asked about one observation after the other.

They are what a guide may be, see `ControllerGuide`. Only these may also have the env itself.
"""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDict

from coil_rl.foreign.controllers import ControllerGuide, load
from coil_rl.foreign.host import asks_for_env, called, role_of
from coil_rl.foreign.remembered import maker_of_rows
from coil_rl.transforms.guide_actions import Guides


class OneRow:
    """A guide as an object with `act`: its env has one row.

    Args:
        guide: anything that a guide may be.
    """

    def __init__(self, guide: Any) -> None:
        self.guides = Guides({"it": ControllerGuide(guide)})
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.memory: dict[Any, torch.Tensor] = {}
        for memory in self.guides.memories.values():
            self.memory |= memory.start(torch.Size([1]), torch.device("cpu"))
        self.starts = True

    def act(self, observation: Any) -> NDArray[Any]:
        """Return the action for an observation, or for one of several entries by name."""
        named = observation if isinstance(observation, Mapping) else {"observation": observation}
        data = TensorDict({key: _entry(value) for key, value in named.items()}, [1])
        data["row"], data["is_init"] = torch.zeros(1, 1).long(), torch.tensor([[self.starts]])
        self.starts = False
        with torch.no_grad():
            return np.asarray(self.guides.advice(data, None, self.memory)[0, 0])


def _entry(value: Any) -> torch.Tensor:
    """Return an entry of one row, as the env of a training has it."""
    entry = torch.as_tensor(np.asarray(value))[None]
    return entry.float() if entry.is_floating_point() else entry


def maker_beside(thing: Any, name: str, env: gymnasium.Env[Any, Any]) -> Callable[[], Any]:
    """Return what makes the object that acts beside an env.

    Args:
        thing: what a guide may be, or its name `MODULE:NAME`. A class or function with a parameter
            `env` gets the env, as `THING(env)` and `THING(env, observation)`.
        name: of the controller, for messages.
        env: beside which it acts.

    Raises:
        ValueError: for what cannot be imported, and for what cannot act.
    """
    thing = load(thing) if isinstance(thing, str) else thing
    role, is_class, asks = role_of(thing), inspect.isclass(called(thing)), asks_for_env(thing)
    if not role:
        raise ValueError(
            f"controller {name}: {getattr(called(thing), '__name__', type(thing).__name__)} needs "
            "a method act(observation)"
        )
    if asks:
        thing = partial(thing, env)
    several = isinstance(env.observation_space, (spaces.Dict, spaces.Tuple))
    if role == "function" and (asks or several):  # it gets the observation as the env gives it
        return partial(SimpleNamespace, act=thing)
    if role == "act":
        return thing if is_class else maker_of_rows(thing)
    return partial(OneRow, thing() if is_class else thing)
