"""Trial of an env and of a controller: a few steps, twice.

What is asked here is asked in the check before a run, and by `coil_rl.testing`: does the env obey
its seed, does the controller act the same again, and does each row act alone?
"""

import math
import random
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.foreign.controllers import PerRow
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import (
    first_choices,
    observed_choices,
    own_shape,
    random_action,
)

STEPS = 10
LONGEST = 0.5  # s, after which a trial of a controller takes no further step
LARGEST_SEED = 2**64  # of a person


def episodes(env: EnvBase, steps: int = STEPS) -> list[TensorDictBase]:
    """Return two rollouts of one seed, between which another one lies; running episodes are lost.

    Args:
        env: the env, with or without transforms.
        steps: of random actions, the same ones in all rollouts.
    """
    # Of the transforms, which have no seed.
    state = env.state_dict() if isinstance(env, TransformedEnv) else None
    act = partial(random_action, env) if len(env.action_keys) == 1 else None
    rollouts = []
    with torch.random.fork_rng():
        for seed in (0, 1, 0):
            if state is not None:
                env.load_state_dict(state)
            env.set_seed(seed)
            torch.manual_seed(0)  # of the actions
            rollouts.append(env.rollout(steps, act, break_when_any_done=False))
    return rollouts[::2]


def unrepeated(env: EnvBase) -> NestedKey | None:
    """Return an entry that differs when an episode is repeated; None if none does."""
    return difference(*episodes(env))


def difference(one: TensorDictBase, other: TensorDictBase) -> NestedKey | None:
    """Return the key of an entry that is another one in other data; None if there is none."""
    return next((key for key, value in one.items(True, True) if not same(value, other[key])), None)


def same(one: Tensor, other: Tensor) -> bool:
    """Return whether two tensors have the same shape and numbers, NaN included."""
    arrays = one.cpu().numpy(), other.cpu().numpy()
    return np.array_equal(*arrays, equal_nan=one.is_floating_point())


class Recorded(EnvBase):
    """Recorded data as an env.

    A reset of all rows begins the data anew; after a reset of some rows they go on in the data.

    Args:
        env: of which the data is.
        data: [B, T].
    """

    def __init__(self, env: EnvBase, data: TensorDictBase) -> None:
        super().__init__(device=env.device, batch_size=data.batch_size[:1])
        rows = data.batch_size[0]
        for name in ("observation_spec", "full_action_spec", "full_reward_spec", "full_done_spec"):
            spec = getattr(env, name).clone()
            setattr(self, name, spec if env.batch_size else spec.expand(rows, *spec.shape))
        self.data, self.step_number = data, 0
        plant = getattr(env, "base_env", env)
        self.first_choices, self.own_shape = first_choices(plant), own_shape(plant)
        self.observed_choices = observed_choices(plant)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        if tensordict is None or "_reset" not in tensordict or tensordict["_reset"].all():
            self.step_number = 0
        return self._present()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.step_number += 1
        return self._present().update(self.full_reward_spec.zero())

    def _present(self) -> TensorDictBase:
        observed = self.data[:, self.step_number].select(*self.observation_spec.keys(True, True))
        return observed.clone().update(self.full_done_spec.zero())

    def _set_seed(self, seed: int | None) -> None:
        pass


class AskedGuide:
    """A guide that is asked along recorded data.

    Args:
        guide: the guide.
        env: of which the data is.
        recorded: the data, [B, T].
        action_key: of the action.
    """

    def __init__(
        self,
        guide: TensorDictModuleBase,
        env: EnvBase,
        recorded: TensorDictBase,
        action_key: NestedKey = "action",
    ) -> None:
        self.action_key, self.recorded = action_key, recorded
        advise = GuideActions({"guide": guide}, action_key)
        self.env = TransformedEnv(Recorded(env, recorded), advise)

    def advice(self, begin: int = 0, reset_at: int | None = None) -> Tensor:
        """Return the advice at each step, [B, T - begin].

        Args:
            begin: step of the data with which the episodes begin.
            reset_at: step at which an episode of row 0 begins anew; None for no reset.
        """
        data, taken = self.recorded[:, begin:].exclude("next"), []
        self.env.base_env.data = data
        present = self.env.reset()
        for step in range(data.shape[1]):
            if step == reset_at:
                mask = torch.zeros(len(data), 1, dtype=torch.bool, device=self.env.device)
                mask[0] = True
                present = self.env.reset(present.set("_reset", mask))
            taken.append(present["guide_action"])
            if step + 1 < data.shape[1]:
                action = TensorDict(
                    {self.action_key: data[self.action_key][:, step]}, present.batch_size
                )
                present = self.env.step(present.update(action))["next"]
        return torch.stack(taken, 1)


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
    """Ask two objects of a controller along a few steps of an env, with other random numbers.

    Other are the global numbers of Python and NumPy, and those of NumPy's generators without a seed
    in copies of one object, which would be as alike as the copies. Those of torch are the same for
    both: a run seeds and saves them. What a controller raises ends the trial: it is said where the
    controller acts for the run.

    Args:
        guide: the guide; one that has no object for each row is not asked.
        env: of one row; its running episode is lost.
    """
    own = getattr(guide, "guide", guide)
    if not isinstance(own, PerRow):
        return Tried()
    first = PerRow(own.make, own.read, own.out_keys[0], own.title)
    again = PerRow(lambda: _reseeded(own.make(), first), own.read, own.out_keys[0], own.title)
    answers = []
    try:
        with _global_numbers_kept():
            recorded = _few_steps(env)
            for seed, probe in enumerate((first, again)):
                torch.manual_seed(0)
                random.seed(seed)
                np.random.seed(seed)
                answers.append(AskedGuide(probe, env, recorded).advice())
    except Exception:
        return Tried()
    one, other = answers
    is_same = first.hosts[0].thing is again.hosts[0].thing or torch.allclose(one, other)
    return Tried(own.title, not is_same, first.hosts[0].seconds)


def _few_steps(env: EnvBase) -> TensorDictBase:
    """Return data [1, T] of random actions until an episode, or the patience, is over."""
    data, end = env.reset(), time.perf_counter() + LONGEST
    taken: list[TensorDictBase] = []
    while len(taken) < STEPS and time.perf_counter() < end and not data["done"].any():
        step = env.step(random_action(env, data))
        taken.append(step)
        data = env.step_mdp(step)
    return torch.stack(taken, 1)


def _reseeded(thing: Any, first: PerRow) -> Any:
    """Return an object with other random numbers than the copy of it that acted first."""
    known = dict(_unseeded(first.hosts[0].thing))
    for number, bits in _unseeded(thing):
        if number not in known:  # what both hold is no copy
            bits.state = type(bits)().state
    return thing


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
