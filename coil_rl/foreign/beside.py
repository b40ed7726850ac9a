"""Controllers beside one env, asked about one observation after the other.

They are what a guide may be, see `ControllerGuide`. Only these may also have the env itself.
"""

import inspect
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDict

from coil_rl.foreign.codec import Codec
from coil_rl.foreign.controllers import ControllerGuide, load
from coil_rl.foreign.host import asks_for_env, called, role_of
from coil_rl.foreign.remembered import Anew, maker_of_rows
from coil_rl.transforms.action_space import ActionSpace
from coil_rl.transforms.guide_actions import Guides


class OneRow:
    """A guide as an object with `act`: its env has one row, and the entries of a training.

    Args:
        guide: anything that a guide may be.
        env: beside which it acts.
    """

    def __init__(self, guide: Any, env: gymnasium.Env[Any, Any]) -> None:
        self.codec = Codec(type(env.unwrapped).__name__, env, torch.float32)
        self.guides = Guides({"it": ControllerGuide(guide)})
        actions = self.codec.actions
        space = ActionSpace(actions.spec, 0, actions.first, actions.own_shape)
        self.guides.tell(space, self.codec.own_forms)
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self.memory: dict[Any, torch.Tensor] = {}
        for memory in self.guides.memories.values():
            self.memory |= memory.start(torch.Size([1]), torch.device("cpu"))
        self.starts = True

    def act(self, observation: Any) -> NDArray[Any]:
        """Return the action for an observation, in the shape in which the guide gives it."""
        data = TensorDict({}, [1])
        for key, value in self.codec.read(observation).items():
            data.set(key, torch.from_numpy(value)[None])
        data["row"], data["is_init"] = torch.zeros(1, 1).long(), torch.tensor([[self.starts]])
        self.starts = False
        given: list[torch.Tensor] = []

        def taken(_: str, action: torch.Tensor, batch: torch.Size) -> torch.Tensor:
            given.append(action[0])
            return action.reshape(*batch, -1)

        with torch.no_grad():
            self.guides.advice(data, taken, self.memory)
        return np.asarray(given[0])


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
        thing = Anew(thing, env)
    several = isinstance(env.observation_space, (spaces.Dict, spaces.Tuple))
    if role == "function" and (asks or several):  # it gets the observation as the env gives it
        return partial(SimpleNamespace, act=thing)
    if role == "act":
        return Anew(thing) if is_class else maker_of_rows(thing)
    return partial(OneRow, thing() if is_class else thing, env)
