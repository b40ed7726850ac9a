"""Trial of an env and of controllers: a few steps, asked again in other ways.

Does the env obey its seed, does the controller act the same again, does each row act alone, and do
both live by their steps and not by the clock? It is the same in the check before a run, when a run
is evaluated, driven or exported, and in `coil_rl.testing`.
"""

import gc
import math
import pickle
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from types import FunctionType, ModuleType
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from coil_rl.foreign.batch import SeededRows, optional_entries, same
from coil_rl.foreign.controllers import PerRow
from coil_rl.foreign.faults import ForeignError
from coil_rl.foreign.gymnasium_env import GymnasiumEnv
from coil_rl.foreign.host import is_of_user
from coil_rl.foreign.limit import layers
from coil_rl.foreign.remembered import pickled
from coil_rl.transforms import GuideActions
from coil_rl.transforms.action_space import random_action, written_key
from coil_rl.transforms.guide_actions import UnfitActionError
from coil_rl.transforms.link import State

STEPS, FEWEST = 10, 3
PATIENCE = 0.02  # s, of a rollout; a slower env takes fewer steps
PAUSE, PAUSED = 0.02, 3  # s, and how many steps have it
JUMP = 10.0  # s, of the clock of Python in a pause
QUICK, SLOW = 1e-6, 1e-4  # s, of a reading of the clock, without and with pauses
# What classes may hold of their rows.
DATA = (int, float, list, dict, set, deque, np.ndarray, Tensor)
LARGEST_SEED = 2**64  # of a person

Kind = Literal["finite", "seed", "clock", "bounds", "input", "rows", "draws", "past"]


class Finding(NamedTuple):
    """What a trial has found.

    Attributes:
        kind: of the fault.
        text: one sentence, with a remedy.
    """

    kind: Kind
    text: str


class Trial:
    """A few steps of an env, and of what acts in it.

    Args:
        env: with or without transforms, of two rows or more where rows are to be compared; its
            running episodes are lost.
        steps: of a rollout, of random actions.
        patience: seconds of a rollout, after which it is shortened.

    Attributes:
        findings: what is wrong.
    """

    def __init__(self, env: EnvBase, steps: int = STEPS, patience: float = math.inf) -> None:
        self.env, self.steps, self.patience = env, steps, patience
        self.base = env.base_env if isinstance(env, TransformedEnv) else env
        self.findings: list[Finding] = []
        self.clock = Clock()
        if isinstance(self.base, GymnasiumEnv):
            self.base.stay_in_process()
        if patience < math.inf:
            self.steps = min(steps, FEWEST)
            self.steps = self._affordable(steps, partial(self._rollout, 0))

    def _affordable(self, most: int, take_few: Callable[[], object]) -> int:
        """Return for how many steps an env or a controller is tried: fewer of a slow one.

        Args:
            most: number of steps of a fast one.
            take_few: lets it take `FEWEST` steps, whose time decides.
        """
        start = time.perf_counter()
        take_few()
        each = (time.perf_counter() - start) / FEWEST
        return int(min(most, max(FEWEST, self.patience / each)))

    def find(self, kind: Kind, text: str) -> None:
        """Take a finding."""
        self.findings.append(Finding(kind, text))

    def ask_env(self) -> None:
        """Ask the env: finite numbers, its seed, the clock, its bounds and its rows."""
        single = self.base.held.plants[0].env if isinstance(self.base, SeededRows) else self.base
        shared = _Shared([type(layer) for layer in layers(single)])
        state = self.env.state_dict() if self.env is not self.base else None
        with torch.random.fork_rng():
            first, _, again = (self._rollout(seed, state) for seed in (0, 1, 0))
            self._look_at_numbers(first)
            changed = difference(first, again)
            if changed is not None:
                self._find_unrepeated(changed)
            elif isinstance(self.base, SeededRows):
                changed = difference(first, self._rollout(0, state, pause=True))
                if changed is not None:
                    key = written_key(changed)
                    self.find("clock", f"{key} of the env differs when time passes {CLOCK}")
            self._look_at_bounds(first)
            self._step_leaves_its_input()
            if changed is None and self.env.batch_size and self.env.batch_size[0] > 1:
                self._reset_of_one_row(shared)

    def _rollout(
        self, seed: int, state: Mapping[str, Any] | None = None, *, pause: bool = False
    ) -> TensorDictBase:
        """Return a rollout of random actions, the same ones for each seed of the env.

        Args:
            state: of the transforms, which have no seed.
            pause: whether time passes before each of the first steps.
        """
        act = _random(self.env)

        def policy(data: TensorDictBase) -> TensorDictBase:
            self.clock.wait()
            return act(data)

        if state is not None:
            self.env.load_state_dict(state)
        self.env.set_seed(seed)
        torch.manual_seed(0)  # of the actions
        with self.clock.with_pauses(PAUSED if pause else 0):
            return self.env.rollout(self.steps, policy, break_when_any_done=False)

    def _look_at_numbers(self, rollout: TensorDictBase) -> None:
        optional = {part for key in optional_entries(self.env) for part in (key, ("next", *key))}
        for key, value in rollout.items(True, True):
            numbers = value.nan_to_num() if key in optional else value
            if value.is_floating_point() and not numbers.isfinite().all():
                self.find("finite", f"{key} holds a number that is not finite")

    def _find_unrepeated(self, key: NestedKey) -> None:
        """Say that an entry differs when an episode is repeated."""
        if isinstance(key, tuple) and key[-2:-1] == ("controller",):
            self.find(
                "draws",
                f"the controller {key[-1]} beside the env gives other actions when an episode is "
                f"repeated: {UNREPEATED}",
            )
            return
        self.find(
            "seed",
            f"the same seed gives other values of {written_key(key)}: the env does not obey its "
            "seed, or lives by the clock, so the cases of an evaluation are not the same for each "
            "policy; draw random numbers from self.np_random or another seeded generator, count "
            "time by steps, and begin each episode anew (env.fresh=true makes a new env for each)",
        )

    def _look_at_bounds(self, rollout: TensorDictBase) -> None:
        """Find each entry of the observation with a number outside of its space."""
        if not isinstance(self.base, GymnasiumEnv):
            return
        if self.base is not self.env:  # transforms may leave out entries
            act = _random(self.base)
            rollout = self.base.rollout(self.steps, act, break_when_any_done=False)
        for entry in self.base.codec.entries:
            if entry.bounds is None:
                continue
            low, high = (np.ravel(bound).astype(np.float64) for bound in entry.bounds)
            shown = torch.cat([rollout[entry.key], rollout["next"][entry.key]])
            rows = shown.reshape(shown.shape[:2].numel(), low.size)
            values = rows.double().cpu().numpy()
            excess = np.maximum(low - values, values - high)
            if excess.size and excess.max() > 0:
                row, index = np.unravel_index(excess.argmax(), excess.shape)
                self.find(
                    "bounds",
                    f"number {index} of {entry.title} is {values[row, index]:g}, but the "
                    f"observation_space of {entry.id} has it from {low[index]:g} to "
                    f"{high[index]:g}; correct its bounds, or the number",
                )

    def _step_leaves_its_input(self) -> None:
        data = _random(self.env)(self.env.reset())
        copy = data.clone()
        self.env.step(data)
        changed = difference(copy, data)
        if changed is not None:
            self.find("input", f"a step changed {changed} of the data before it; write new tensors")

    def _reset_of_one_row(self, shared: "_Shared") -> None:
        """Compare a step after the reset of row 0 with the same step without it.

        An env that draws random numbers in its steps may differ anyway: so the step is compared
        only if another seed makes no difference.
        """
        env, act = self.base, _random(self.base)

        def seed(present: TensorDictBase) -> TensorDictBase:
            env.set_seed(1)
            return present

        def second_step(change: Callable[[TensorDictBase], TensorDictBase]) -> TensorDictBase:
            env.set_seed(0)
            torch.manual_seed(0)
            present = change(env.step_mdp(env.step(act(env.reset()))))
            torch.manual_seed(0)  # of the action
            return env.step(act(present))["next"]

        plain, seeded = second_step(lambda present: present), second_step(seed)
        changed = difference(plain[1:], second_step(partial(_with_new_row, env))[1:])
        if difference(plain, seeded) is None and changed is not None:
            self.find(
                "rows",
                f"resetting row 0 changed {written_key(changed)} of other rows in the next step: "
                f"all rows share {shared.changed() or SOMETHING}; make it in __init__, for each "
                "object its own",
            )

    def recorded(self) -> TensorDictBase:
        """Return data [B, T] of random actions, with at least two rows.

        For an env without batch dimension these are two episodes.

        Raises:
            ValueError: for an env of one row.
        """
        env, act = self.env, _random(self.env)
        with torch.no_grad():
            if env.batch_size:
                recorded: TensorDictBase = env.rollout(self.steps, act, break_when_any_done=False)
            else:
                pair = [env.rollout(self.steps, act, break_when_any_done=False) for _ in range(2)]
                shortest = min(map(len, pair))
                recorded = TensorDict.stack([episode[:shortest] for episode in pair])
        if len(recorded.batch_size) != 2 or len(recorded) < 2:
            raise ValueError(
                "check_guide needs an env with one batch dimension of at least 2 rows, not "
                f"{list(env.batch_size)}; make it with more, such as GymnasiumEnv(ID, num_envs=2)"
            )
        return recorded

    def ask_guide(
        self,
        guide: TensorDictModuleBase,
        recorded: TensorDictBase,
        action_key: NestedKey,
        tolerance: float,
    ) -> None:
        """Ask a guide without random numbers what its advice depends on over an episode.

        Args:
            guide: it is asked itself.
            recorded: along this data, see `recorded`.
            action_key: of the action.
            tolerance: allowed effect of other rows.
        """
        ask = partial(self._advice, guide, action_key=action_key)
        equal = partial(torch.allclose, rtol=0, atol=tolerance)
        self._ask("the guide", ask, recorded, equal, _Shared([type(guide)]), alone=False)
        if self.findings:
            return
        middle = recorded.shape[1] // 2
        fresh = ask(recorded[:, middle:])
        if not equal(ask(recorded, reset_at=middle)[0, middle:], fresh[0]):
            self.find(
                "past",
                "the guide's action after the reset of a row depends on what was before it, or on "
                "the other rows",
            )

    def _ask(
        self,
        title: str,
        ask: Callable[..., Tensor],
        recorded: TensorDictBase,
        equal: Callable[[Tensor, Tensor], bool],
        shared: "_Shared",
        *,
        alone: bool,
    ) -> None:
        """Find the first of what makes advice another one for the same observations.

        Args:
            title: of what is asked.
            ask: returns its advice along data, see `_advice`.
            equal: whether advice is the same.
            shared: of its class.
            alone: whether a row without others must get the same.
        """
        first = ask(recorded)
        if not equal(first, ask(recorded)):
            text = f"{title} gives other actions for the same observations from the same start"
            names = shared.changed()
            shared.restore()
            if names and equal(first, ask(recorded)):
                self.find("rows", f"{text}: {_shares(names)}")
            else:
                self.find("draws", f"{text}: {UNREPEATED}")
            return
        # First, because the readings of one row pass the time of the others.
        if not equal(first, ask(recorded, pause=True)):
            self.find("clock", f"{title} gives other actions when time passes {CLOCK}")
            return
        try:
            reset = ask(recorded, reset_at=recorded.shape[1] // 2)
        except (IndexError, RuntimeError) as error:
            self.find(
                "past",
                f"{title} fails after a single row was reset, so it may remember in itself, not in "
                f"entries: {error}",
            )
            return
        others = equal(first[1:], reset[1:])
        if not others or (alone and not equal(first[:1], ask(recorded[:1]))):
            names = shared.changed() or SOMETHING
            self.find(
                "rows", f"{title} gives a row other actions beside other rows: {_shares(names)}"
            )

    def _advice(
        self,
        guide: TensorDictModuleBase,
        data: TensorDictBase,
        action_key: NestedKey = "action",
        *,
        reset_at: int | None = None,
        pause: bool = False,
    ) -> Tensor:
        """Return the advice of a guide at each step of recorded data, [B, T].

        Args:
            guide: the guide.
            data: [B, T].
            action_key: of the action.
            reset_at: step at which an episode of row 0 begins anew; None for no reset.
            pause: whether time passes before each of the first steps.
        """
        env = TransformedEnv(self.base, GuideActions({"guide": guide}, action_key))
        link, observed = env.transform, list(self.env.observation_spec.keys(True, True))
        row = torch.arange(len(data), device=data.device)[:, None]
        state: State = {}
        taken = []
        with self.clock.with_pauses(PAUSED if pause else 0):
            for step in range(data.shape[1]):
                if step:
                    self.clock.wait()
                present = data[:, step].select(*observed).clone()
                state = link.sent(data[:, step - 1], state) if step else link.first(present)
                state = link.observe(present, state | {"row": row})
                advice = present["guide_action"]
                if step == reset_at:
                    new = present[:1].clone()
                    begun = link.observe(new, link.first(new) | {"row": row[:1]})
                    state = {key: torch.cat([begun[key], state[key][1:]]) for key in begun}
                    advice = torch.cat([new["guide_action"], advice[1:]])
                taken.append(advice)
        return torch.stack(taken, 1)

    def ask_controller(self, guide: TensorDictModuleBase) -> None:
        """Ask objects of a controller along a few steps, each time new ones.

        Random numbers without a seed are others each time: those of NumPy's generators in copies of
        one object would be as alike as the copies. What a controller raises ends the trial: it is
        said where it acts for the run.

        Args:
            guide: one that has no object for each row is not asked.
        """
        own = getattr(guide, "guide", guide)
        if not isinstance(own, PerRow):
            return
        with suppress(ForeignError, UnfitActionError), torch.random.fork_rng():
            torch.manual_seed(0)
            recorded, first = self.recorded(), _new(own, own.make)
            few = recorded[:, :FEWEST]
            steps = self._affordable(recorded.shape[1], lambda: self._advice(first, few))

            def ask(data: TensorDictBase, **how: Any) -> Tensor:
                again = _new(own, lambda: _reseeded(own.make(), first))
                return self._advice(again, data, **how)

            title, shared = f"the controller {own.title}", _Shared([type(first.hosts[0].thing)])
            self._ask(title, ask, recorded[:, :steps], torch.allclose, shared, alone=True)


SOMETHING = "something, such as an attribute or a default argument of their class"
CLOCK = (
    "between two steps: it reads the clock, so the result depends on how busy the machine is; "
    "count time by steps, such as sample_time=None of a PID controller"
)
UNREPEATED = (
    "it draws random numbers that no seed of the run reaches, such as from a generator without a "
    "seed, reads the clock, or keeps something that no reset reaches, so the run cannot be "
    "repeated or resumed to the bit; give it a generator of its own with a seed, such as "
    "np.random.default_rng(0), count time by steps, such as sample_time=None of a PID controller, "
    "and make in __init__ what it remembers"
)


def _shares(names: str) -> str:
    return f"all rows share {names}; make it in __init__, for each object its own"


class Clock:
    """The clock of Python, which stands still in a block, but for the pauses that are made there.

    What is asked twice at two speeds is then asked the same, unless it reads another clock. Each
    reading takes a microsecond, so that a loop which waits ends, and more where pauses are made: a
    search that ends by the clock ends earlier.
    """

    names = ("time", "monotonic", "perf_counter", "time_ns", "monotonic_ns", "perf_counter_ns")
    dates = ("gmtime", "localtime")

    def __init__(self) -> None:
        self.read = {name: getattr(time, name) for name in (*self.names, *self.dates)}
        self.start = {name: self.read[name]() for name in self.names}
        self.tick = QUICK

    def __enter__(self) -> "Clock":
        self.passed = 0.0
        for name in self.read:
            setattr(time, name, partial(self._now, name))
        return self

    def __exit__(self, *_: object) -> None:
        self.tick = QUICK
        for name, read in self.read.items():
            setattr(time, name, read)

    def _now(self, name: str, *given: float) -> Any:
        if name in self.dates:
            return self.read[name](*(given or [self._now("time")]))
        self.passed += self.tick
        since = round(self.passed * 1e9) if name.endswith("_ns") else self.passed
        return self.start[name] + since

    def with_pauses(self, number: int) -> "Clock":
        """Make so many of the next calls of `wait` pauses."""
        self.left = number
        return self

    def wait(self) -> None:
        """Let time pass, if this is a pause: much by this clock, and some by every other one."""
        if self.left:
            self.left -= 1
            self.passed += JUMP
            self.tick = SLOW
            time.sleep(PAUSE)


class _Shared:
    """What all objects of some classes share: attributes, default arguments, the module.

    Args:
        kinds: the classes.
    """

    def __init__(self, kinds: Sequence[type]) -> None:
        own = [each for kind in kinds for each in kind.__mro__ if is_of_user(each)]
        self.kinds = dict.fromkeys(own)
        self.before = {name: pickled(value) for name, value, _ in self._things()}

    def changed(self) -> str:
        """Return the names of what has changed; empty for nothing."""
        return " and ".join(dict.fromkeys(name for name, *_ in self._changed()))

    def restore(self) -> None:
        """Restore the values that have changed."""
        for name, _, put in list(self._changed()):
            put(pickle.loads(self.before[name]))

    def _changed(self) -> Iterator[tuple[str, Any, Any]]:
        for name, value, put in self._things():
            if self.before.get(name) and pickled(value) != self.before[name]:
                yield name, value, put

    def _things(self) -> Iterator[tuple[str, Any, Any]]:
        """Yield name, value, and what sets it."""
        for kind in self.kinds:
            for name, value in list(vars(kind).items()):  # to pickle an object adds to its class
                title = f"{kind.__name__}.{name}"
                if isinstance(value, FunctionType):
                    given = [each for each in value.__defaults__ or () if _is_data(each)]
                    yield f"a default of {title}", given, partial(_set_defaults, value)
                elif _is_data(value) and not name.startswith("__"):
                    yield title, value, partial(setattr, kind, name)
            module = sys.modules.get(kind.__module__)
            for name, value in vars(module).items() if module else ():
                if isinstance(value, DATA) and not name.startswith("__"):
                    yield f"{kind.__module__}.{name}", value, partial(setattr, module, name)


def _set_defaults(function: FunctionType, then: Sequence[Any]) -> None:
    """Give a function back the default arguments that are data."""
    left, given = iter(then), function.__defaults__ or ()
    function.__defaults__ = tuple(next(left) if _is_data(each) else each for each in given)


def _is_data(value: Any) -> bool:
    """Return whether a value may be what rows share: data, or an object of a user's class."""
    return isinstance(value, DATA) or (not isinstance(value, type) and is_of_user(type(value)))


def _random(env: EnvBase) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return what writes a random action, also where it has no bound."""
    return partial(random_action, env) if len(env.action_keys) == 1 else env.rand_action


def _new(own: PerRow, make: Callable[[], Any]) -> PerRow:
    return PerRow(make, own.read, own.out_keys[0], own.title, own.as_one)


def difference(one: TensorDictBase, other: TensorDictBase) -> NestedKey | None:
    """Return the key of an entry that is another one in other data; None if there is none."""
    return next((key for key, value in one.items(True, True) if not same(value, other[key])), None)


def _with_new_row(env: EnvBase, present: TensorDictBase) -> TensorDictBase:
    """Return the data of an env after a reset of row 0."""
    done = torch.zeros(len(present), 1, dtype=torch.bool, device=env.device)
    mask = torch.zeros_like(present.get("done", done))
    mask[0] = True
    return env.reset(present.set("_reset", mask))


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
        if id(value) in seen or isinstance(value, (type, ModuleType, FunctionType)):
            continue
        seen.add(id(value))
        if not isinstance(value, (np.random.Generator, np.random.RandomState)):
            waiting.extend(gc.get_referents(value))
            continue
        holder: Any = value
        bits = getattr(holder, "bit_generator", None) or holder._bit_generator
        entropy = getattr(bits.seed_seq, "entropy", None)
        if isinstance(entropy, int) and entropy >= LARGEST_SEED:
            yield id(bits), bits
