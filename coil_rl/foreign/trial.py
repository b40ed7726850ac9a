"""Check whether a controller gives the same actions again, and how long it takes for one."""

import math
import random
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.foreign.controllers import PerRow
from coil_rl.foreign.faults import action_array
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import ActionSpace

STEPS = 10
LONGEST = 0.5  # s, after which the check takes no further step
LARGEST_SEED = 2**64  # of a person


class Twins:
    """Two objects of a controller that get the same observations, but other random numbers.

    It acts as the first of them. Other are the global numbers, and those of NumPy's generators
    without a seed in copies of one object, which would be as alike as the copies. Those of torch
    are the same for both: a run seeds and saves them.

    Args:
        make: makes an object; called without arguments.

    Attributes:
        differ: whether the two gave different actions.
        seconds: the shortest time that an action took; infinite before the first.
    """

    def __init__(self, make: Callable[[], Any]) -> None:
        self.calls, self.differ, self.seconds = 0, False, math.inf
        self.objects = [self._answer(number, make) for number in range(2)]
        first, second = (dict(_unseeded(thing)) for thing in self.objects)
        for number in second.keys() - first.keys():  # what both hold is no copy
            second[number].state = type(second[number])().state
        for number, thing in enumerate(self.objects):
            if hasattr(thing, "reset"):
                self._answer(number, thing.reset)

    def act(self, *observed: NDArray[Any]) -> Any:
        """Return the action of the first object.

        Args:
            observed: what the controller reads.
        """
        self.calls += 1
        answers = []
        for number, thing in enumerate(self.objects):
            ask = partial(thing.act, *(each.copy() for each in observed))
            start = time.perf_counter()
            answers.append(self._answer(number, ask))
            self.seconds = min(self.seconds, time.perf_counter() - start)
        first, other = map(action_array, answers)
        if first.shape != other.shape or not np.allclose(first, other, equal_nan=True):
            self.differ = self.objects[0] is not self.objects[1]
        return answers[0]

    def _answer(self, number: int, ask: Callable[[], Any]) -> Any:
        """Return what an object gives with the global random numbers of its own."""
        torch.manual_seed(self.calls)
        random.seed(2 * self.calls + number)
        np.random.seed(2 * self.calls + number)
        return ask()


def _unseeded(thing: Any) -> Iterator[tuple[int, Any]]:
    """Yield NumPy's generators in an object that were made without a seed, by their id.

    Such a generator has 128 bits of the operating system for a seed.
    """
    seen, waiting = set[int](), [thing]
    while waiting:
        value = waiting.pop()
        if id(value) in seen or isinstance(value, (type, ModuleType, FunctionType, float, str)):
            continue
        seen.add(id(value))
        if isinstance(value, (np.random.Generator, np.random.RandomState)):
            holder: Any = value
            bits = getattr(holder, "bit_generator", None) or holder._bit_generator
            entropy = getattr(bits.seed_seq, "entropy", None)
            if isinstance(entropy, int) and entropy >= LARGEST_SEED:
                yield id(bits), bits
        elif isinstance(value, Mapping):
            waiting.extend(value.values())
        elif isinstance(value, (list, tuple, set, deque)):
            waiting.extend(value)
        elif hasattr(value, "__dict__"):
            waiting.extend(vars(value).values())


class Tried(NamedTuple):
    """Result of a trial of a controller in a few steps.

    Attributes:
        title: of the controller; empty for a guide that has no object for each row.
        unseeded: whether it does not act the same again.
        seconds: for an action of one row; infinite if it was not measured.
    """

    title: str = ""
    unseeded: bool = False
    seconds: float = math.inf


def tried(guide: TensorDictModuleBase, env: EnvBase) -> Tried:
    """Let two new objects of a controller act side by side in a few steps of an env.

    What either of them raises ends the check: it is said where the controller acts for the run.

    Args:
        guide: the guide; one that has no object for each row is not asked.
        env: of one row, in which the guide can act; its running episode is lost.
    """
    own = getattr(guide, "guide", guide)
    if not isinstance(own, PerRow):
        return Tried()
    twins: list[Twins] = []

    def make() -> Twins:
        twins.append(Twins(own.make))
        return twins[-1]

    probe = PerRow(make, own.read, own.out_keys[0], own.title)
    advised = TransformedEnv(env, GuideActions({"guide": probe}))
    space = ActionSpace(advised.full_action_spec["action"], advised.batch_dims)
    end = time.perf_counter() + LONGEST
    try:
        with _global_numbers_kept():
            data = advised.reset()
            for _ in range(STEPS):
                if time.perf_counter() > end or data["done"].any():
                    break
                action = space.actions(data["guide_action"].select(-2, 0))
                data = advised.step_mdp(advised.step(data.set("action", action)))
    except Exception:
        return Tried()
    seconds = min((each.seconds for each in twins), default=math.inf)
    return Tried(own.title, any(each.differ for each in twins), seconds)


@contextmanager
def _global_numbers_kept() -> Iterator[None]:
    """Restore the states of the global random generators after the block."""
    states = random.getstate(), np.random.get_state()
    try:
        with torch.random.fork_rng():
            yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])
