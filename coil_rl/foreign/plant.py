"""One env of other people: begun, stepped, drawn and closed, with every answer checked.

Arrays are copied, because many envs return one buffer at every step.
"""

import copy
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, MutableMapping
from contextlib import suppress
from typing import Any, ClassVar
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.foreign.beside import maker_beside
from coil_rl.foreign.codec import Codec
from coil_rl.foreign.faults import (
    FaultError,
    ForeignError,
    flag,
    foreign,
    one_number,
    shortened,
    shown,
)
from coil_rl.foreign.guard import Numbers
from coil_rl.foreign.host import Host
from coil_rl.foreign.limit import limit_of, limits_of, warn_of_limit
from coil_rl.foreign.makers import Env
from coil_rl.foreign.remembered import own

OLD_LIMIT = "TimeLimit.truncated"  # in info: how older envs say that the time was over
MASKS = {"action_mask", "action_masks"}  # in info: which actions are possible


class Plant(ABC):
    """One env of somebody else.

    Args:
        name: of the env, for messages.
        row: its number in a batch, for messages.

    Attributes:
        seed: of the running episode.
        steps: since its reset.
        numbers: global random numbers as the env and the controllers beside it see them.
    """

    def __init__(self, name: str, row: int) -> None:
        self.name, self.row, self.seed, self.steps = name, row, 0, 0
        self.numbers = Numbers()

    def begin(self, seed: int) -> None:
        """Begin an episode; a `ForeignError` for what the env raises, or returns that is none."""
        self.seed, self.steps = seed, 0
        self.numbers.seed(seed)
        with self.numbers:
            self._begin()

    def step(self, action: Any) -> None:
        """Take a step; after the end of an episode nothing changes, and the reward is 0.

        Errors are those of `begin`.
        """
        with self.numbers:
            self._step(action)

    @abstractmethod
    def _begin(self) -> None:
        """Begin an episode with the seed."""

    @abstractmethod
    def _step(self, action: Any) -> None:
        """Take a step."""

    @property
    def place(self) -> str:
        """Where the env is: its name, the row, the seed of the episode and the step."""
        return f"the env {self.name} (row {self.row}, seed {self.seed}, step {self.steps})"


class GymnasiumPlant(Plant):
    """One Gymnasium env and the controllers beside it.

    Args:
        make: makes the env.
        makers: make the controllers, by name.
        options: of each reset.
        fresh: whether every episode has a new env.
        row: its number in a batch.

    Attributes:
        env: the present env.
        limit: steps after which an episode is truncated, with a warning; None for no limit.
        codec: of its spaces, which all rows share.
        observation: the last one, as the env returned it.
        values: copies of its entries, by their keys.
        advice: of the controllers, by name.
    """

    # The envs of all rows of this process, to find one that two rows would share.
    alive: ClassVar[MutableMapping[int, Any]] = WeakValueDictionary()
    codec: Codec

    def __init__(
        self,
        make: Callable[[], Env],
        makers: Mapping[str, Any],
        options: Mapping[str, Any] | None,
        fresh: bool,
        name: str,
        row: int,
    ) -> None:
        super().__init__(name, row)
        self.make, self.makers, self.fresh = make, makers, fresh
        self.options = dict(options or {})
        self.size: tuple[int, ...] | None = None  # of the pictures
        self.values: dict[NestedKey, NDArray[Any]] = {}
        self.advice: dict[str, NDArray[Any]] = {}
        with Numbers(row):
            self._open()

    def _open(self) -> None:
        self.env = env = self.make()
        if self.alive.get(id(env.unwrapped)) is env.unwrapped:
            raise ValueError(
                f"the maker of {self.name} returned one env twice: its rows would disturb each "
                "other; make a new env at each call"
            )
        with suppress(TypeError):  # an object without weak references
            self.alive[id(env.unwrapped)] = env.unwrapped
        self.limit = limit_of(env)
        self.controllers = {
            name: Host(maker_beside(thing, name, env), name, beside=lambda: self.place)
            for name, thing in self.makers.items()
        }

    def _begin(self) -> None:
        """Begin an episode; the answer must be two values, and the observation fit its space."""
        if self.fresh:
            self.close()
            self.alive.pop(id(self.env.unwrapped), None)
            self._open()
        given: dict[str, Any] = {"options": own(self.options)} if self.options else {}
        with foreign(self.place, "reset"):
            answer: Any = self.env.reset(seed=self.seed, **given)
            if not isinstance(answer, (tuple, list)) or len(answer) != 2:
                raise FaultError(
                    f"reset returned {_counted(answer)}, not the two of Gymnasium (observation, "
                    "info)"
                )
            self.observation, self.info = answer
            if not isinstance(self.info, Mapping):
                raise FaultError(f"info of reset is {shown(self.info)}, not a dictionary")
            self._look_for_masks()
            self.values = self.codec.read(self.observation)
        self.reward, self.terminated, self.truncated = 0.0, False, False
        self._begin_controllers()
        self._advise()

    def _step(self, action: Any) -> None:
        """Take a step; the answer must be five values: observation, reward, two flags and info."""
        if self.is_over:
            self.reward = 0.0
            return
        self.steps += 1
        try:  # without `foreign`, which costs as much as a step of a small env
            self._take(self.env.step(action))
            self.values = self.codec.read(self.observation)
        except BaseException as error:
            with foreign(self.place, "step"):
                raise error
        if self.codec.fineness.unseen:
            self.codec.fineness.see(np.asarray(self.reward))
        if self.limit is not None and self.steps >= self.limit and not self.is_over:
            warn_of_limit(self.name, self.limit, "TimeLimit")
            self.truncated = True
        if self.controllers and not self.terminated:
            self._advise()

    def _take(self, answer: Any) -> None:
        """Keep the checked values of a step."""
        if not isinstance(answer, (tuple, list)) or len(answer) != 5:
            raise FaultError(
                f"step returned {_counted(answer)}, not the five of Gymnasium (observation, "
                "reward, terminated, truncated, info)"
            )
        self.observation, reward, terminated, truncated, info = answer
        # The usual types need no closer look, which would take as long as a step of a small env.
        if not (
            isinstance(reward, float)
            and type(terminated) is type(truncated) is bool
            and type(info) is dict
            and -self.codec.largest <= reward <= self.codec.largest
        ):
            if not isinstance(info, Mapping):
                raise FaultError(f"info of step is {shown(info)}, not a dictionary")
            reward = one_number(reward, "the reward")
            if not abs(reward) <= self.codec.largest:
                floats = self.codec.floats
                raise FaultError(f"the reward is {reward}, not a finite number of {floats}")
            terminated, truncated = flag(terminated, "terminated"), flag(truncated, "truncated")
        if terminated and not truncated and info.get(OLD_LIMIT):
            warnings.warn(
                f"info of the env {self.name} says {OLD_LIMIT} at a step with terminated=True: it "
                "is a termination, after which nothing is earned; where only the time was over "
                "return terminated=False, truncated=True",
                stacklevel=2,
            )
        self.reward, self.info = float(reward), info
        self.terminated, self.truncated = terminated, truncated

    def observe(self, observation: Any, *, first: bool) -> None:
        """Take an observation that comes from elsewhere."""
        if not hasattr(self, "observation"):
            self.begin(0)  # controllers may read what an env has after its reset only
        self.observation, self.reward, self.info = observation, 0.0, {}
        try:
            self.values = self.codec.read(observation)
        except ForeignError as error:
            raise ValueError(f"it does not fit the env {self.name}: {error}") from error
        with self.numbers:
            if first:
                self._begin_controllers()
            self._advise()

    @property
    def is_over(self) -> bool:
        """Whether the episode has ended."""
        return self.terminated or self.truncated

    def _look_for_masks(self) -> None:
        """Warn if info has a mask of the possible actions, which policies do not read."""
        for name in MASKS & self.info.keys():
            warnings.warn(
                f"the env {self.name} has {name} in info, which is not used: policies and guides "
                "choose among all actions, so the env must have an answer to each",
                stacklevel=2,
            )

    def number_of(self, name: str) -> float:
        """Return a number of info, NaN where it is missing."""
        value = self.info.get(name, math.nan)
        if np.ndim(value) == 1 and np.size(value) == 1:
            value = np.ravel(value)[0]
        with foreign(self.place, "info"):
            return one_number(value, f"info entry {name!r}")

    def _begin_controllers(self) -> None:
        for host in self.controllers.values():
            host.begin()

    def _advise(self) -> None:
        for name, host in self.controllers.items():
            # A copy, as the env may go on with the arrays that it returned.
            action = host.act(copy.deepcopy(self.observation))
            self.advice[name] = self.codec.actions.fitted(action, host.place)

    def render(self) -> NDArray[np.uint8]:
        """Return a copy of a picture, [height, width] or [height, width, 3 or 4].

        Raises:
            ForeignError: for an exception of the env, and for what is no picture, or one of another
                size than before.
        """
        with foreign(f"the env {self.name}", "render"):
            picture: Any = self.env.render()
        found = isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.size > 0
        if not found or not (
            picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] in (3, 4))
        ):
            raise ForeignError(
                f"render returned {shown(picture)}, not a picture [height, width, 3] of uint8"
            )
        if self.size not in (None, picture.shape):
            raise ForeignError(
                f"render returned a picture of the shape {list(picture.shape)} after one of "
                f"{list(self.size or ())}"
            )
        self.size = picture.shape
        return picture.copy()

    def close(self) -> None:
        """Close the env; what it raises is a warning, because nothing depends on it any more."""
        try:
            self.env.close()
        except Exception as error:
            warnings.warn(
                f"the env {self.name} cannot be closed ({type(error).__name__}: "
                f"{shortened(str(error))})",
                stacklevel=2,
            )


def _counted(answer: Any) -> str:
    """Return how many values there are, or what else an env has returned."""
    return f"{len(answer)} values" if isinstance(answer, (tuple, list)) else shown(answer)


class TorchRLPlant(Plant):
    """One TorchRL env without a batch.

    Args:
        env: the env.
        row: its number in a batch.

    Attributes:
        after: the entries after the last step or reset.
    """

    def __init__(self, env: EnvBase, row: int) -> None:
        own = env.base_env if isinstance(env, TransformedEnv) else env
        super().__init__(type(own).__name__, row)
        for limit in limits_of(env):
            env = TransformedEnv(env, limit)
        self.env = env

    def _begin(self) -> None:
        with foreign(self.place, "reset"):
            self.env.set_seed(self.seed)
            self.after = self.state = self.env.reset()

    def _step(self, action: Tensor) -> None:
        reward = self.env.reward_key
        if self.after["done"].any():
            self.after = self.after.copy().set(reward, self.env.full_reward_spec[reward].zero())
            return
        self.steps += 1
        given = self.state.copy().set(self.env.action_key, action.to(self.env.device))
        with foreign(self.place, "step"):
            step = self.env.step(given)
            self.after, self.state = step["next"], self.env.step_mdp(step)
