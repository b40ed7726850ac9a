"""Guard of the settings and global random numbers of the process against foreign code.

An env that seeds torch would make the exploration noise of all its episodes equal, one that changes
the folder would break the paths of the run. So foreign code has its own: what it sets holds when it
is called again, and what the process had is back after each call.
"""

import ctypes
import logging
import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch import _tensor_str as tensor_str
from torch.utils import _device as _torch_device

WATCHED = 12  # first calls of a row, more than in a trial: does it use the global numbers?
NUMBERS = "global random numbers"  # key of a saved state
SEEDS = 2**32  # seeds of NumPy are below
# Those that end a program; not each system has all.
NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
SIGNALS = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]

GlobalNumbers = tuple[Any, list[Tensor], bytes, float | None]  # of NumPy, torch and Python


def _state_of(generator: Any) -> Any:
    """Return the state of a generator of Python in place: 624 numbers of four bytes, and an index.

    It is the generator's own memory, so it is valid as long as the generator lives. `getstate`
    takes fifty times as long, because it makes an object of each number.
    """
    return (ctypes.c_char * (4 * 625)).from_address(id(generator) + object.__basicsize__)


_PYTHON: Any = random._inst  # the global one
_STATE = _state_of(_PYTHON)


def _folder() -> str | None:
    try:
        return os.getcwd()
    except OSError:  # it was removed
        return None


def _go_to(folder: str | None) -> None:
    with suppress(OSError):
        if folder is not None:
            os.chdir(folder)


def _warnings() -> tuple[Any, ...]:
    return warnings.filters[:], warnings.showwarning, warnings.formatwarning


def _set_warnings(state: tuple[Any, ...]) -> None:
    filters, warnings.showwarning, warnings.formatwarning = state
    with warnings.catch_warnings():  # its end makes Python look at the new filters
        pass
    warnings.filters[:] = filters  # type: ignore[index]


def _set_path(folders: list[str]) -> None:
    sys.path[:] = folders


def _set_recursion(limit: int) -> None:
    with suppress(RecursionError):  # one that is reached already
        sys.setrecursionlimit(limit)


def _set_handler(number: int, handler: Any) -> None:
    # None is one that C code has set; other threads cannot set any.
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(number, handler)


# What reads a setting of the process, and what sets it. The first ones take a microsecond.
SETTINGS: list[tuple[Callable[[], Any], Callable[[Any], Any]]] = [
    (_folder, _go_to),
    (torch.get_default_dtype, torch.set_default_dtype),
    (torch.is_grad_enabled, torch._C._set_grad_enabled),
    (partial(torch.is_autocast_enabled, "cpu"), partial(torch.set_autocast_enabled, "cpu")),
    (torch.get_num_threads, torch.set_num_threads),
    (lambda: logging.root.manager.disable, logging.disable),
    *[
        (partial(getattr, logger, "level"), logger.setLevel)
        for logger in (logging.root, logging.getLogger("coil_rl"))
    ],
    (_warnings, _set_warnings),
    (np.get_printoptions, lambda options: np.set_printoptions(**options)),
    (np.geterr, lambda errors: np.seterr(**errors)),
    (vars(tensor_str.PRINT_OPTS).copy, vars(tensor_str.PRINT_OPTS).update),
    (lambda: sys.stdout, partial(setattr, sys, "stdout")),
    (lambda: sys.stderr, partial(setattr, sys, "stderr")),
    # `torch.get_default_device` takes eighty times as long.
    (lambda: _torch_device.CURRENT_DEVICE, torch.set_default_device),
    (lambda: sys.path[:], _set_path),
    (sys.getrecursionlimit, _set_recursion),
]
QUICK = len(SETTINGS)
SETTINGS += [
    (torch.are_deterministic_algorithms_enabled, torch.use_deterministic_algorithms),
    (torch.get_float32_matmul_precision, torch.set_float32_matmul_precision),
]
KEPT = len(SETTINGS)  # but of handlers: without ours a Ctrl-C would be missed
SETTINGS += [
    (partial(signal.getsignal, number), partial(_set_handler, number)) for number in SIGNALS
]


class Numbers:
    """The global random numbers of torch, NumPy and Python, as foreign code sees them.

    They belong to a row, or to a controller, and are seeded. So rows are separate in any number of
    processes, also if they seed the process, and one that draws without a seed can be repeated.
    Code that does not use them in its first calls is left with those of the process, which takes no
    time; `Guard` notices when it does later.

    Args:
        seed: any whole number.
    """

    def __init__(self, seed: int = 0) -> None:
        self.watched, self.used = WATCHED, False
        self.seed(seed)

    @property
    def active(self) -> bool:
        """Whether a call needs these numbers, or it is not known yet."""
        return self.used or self.watched > 0

    def of_call(self) -> AbstractContextManager[None]:
        """Return what is around a call of the code."""
        return self if self.active else nullcontext()

    def use(self, seed: int) -> None:
        """Use these numbers from here on: the code was seen to use global ones."""
        if not self.active:
            self.used = True
            self.seed(seed)

    def seed(self, seed: int) -> None:
        """Begin anew with a seed, unless they are not used."""
        if not self.active:
            return
        seed %= SEEDS
        states = [torch.Generator().manual_seed(seed).get_state()]
        python = random.Random(seed)  # it must live while its state is read in place
        self.own: GlobalNumbers = np.random.MT19937(seed), states, _state_of(python).raw, None

    def __enter__(self) -> None:
        self.first = [] if self.used else _plain(self.own)
        self.before = _numbers()
        _set_numbers(self.own)

    def __exit__(self, *_: object) -> None:
        self.own = self.own[0], *_numbers()[1:]
        _set_numbers(self.before)
        if not self.used:
            self.watched -= 1
            self.used = _plain(self.own) != self.first

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the generators as plain values; empty if they are not used."""
        if not self.used:
            return {}
        bits, states, raw, gauss = self.own
        python, numpy = random.Random(), bits.state["state"]
        _state_of(python).raw, python.gauss_next = raw, gauss  # type: ignore[attr-defined]
        key, pos = numpy["key"].tolist(), int(numpy["pos"])
        return {"torch": states, "python": python.getstate(), "numpy": [key, pos]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        if not state:
            return
        self.used = True
        version, numbers, gauss = state["python"]
        python, bits = random.Random(), self.own[0]
        python.setstate((version, tuple(numbers), gauss))
        key, pos = state["numpy"]
        inner = {"key": np.array(key, np.uint32), "pos": pos}
        bits.state = {"bit_generator": "MT19937", "state": inner}
        self.own = bits, list(state["torch"]), _state_of(python).raw, gauss


def _numbers() -> GlobalNumbers:
    """Return the generator of NumPy, and the states of those of torch and Python."""
    return np.random.mtrand.get_bit_generator(), _of_torch(), _STATE.raw, _PYTHON.gauss_next


def _set_numbers(numbers: GlobalNumbers) -> None:
    bits, states, _STATE.raw, _PYTHON.gauss_next = numbers
    np.random.mtrand.set_bit_generator(bits)
    torch.default_generator.set_state(states[0])
    for generator, state in zip(torch.cuda.default_generators, states[1:], strict=False):
        generator.set_state(state)


def _plain(numbers: GlobalNumbers) -> list[Any]:
    """Return what tells states of generators apart."""
    bits, states, *python = numbers
    numpy = bits.state["state"]
    return [numpy["key"].tobytes(), numpy["pos"], *map(_bytes, states), *python]


def _of_torch() -> list[Tensor]:
    """Return the states of torch's random generators, that of the CPU first."""
    states = [torch.default_generator.get_state()]
    if torch.cuda.is_initialized():
        states += [generator.get_state() for generator in torch.cuda.default_generators]
    return states


def _bytes(state: Tensor) -> bytes:
    return ctypes.string_at(state.data_ptr(), state.numel())  # sooner than by NumPy


class Guard:
    """Keeps from the process what foreign code does to it in a block: a batch of calls.

    Attributes:
        touched: whether the last block has used the numbers of the process.
    """

    def __init__(self) -> None:
        self.theirs: dict[int, Any] = {}  # what the foreign code has set, by its place in SETTINGS
        self.bits, self.same_bits = np.random.MT19937(0), np.random.MT19937(0)
        self.touched, self.count = False, QUICK

    def __deepcopy__(self, memo: Any) -> "Guard":
        """Return a guard with what foreign code has set; what the process has is not copied."""
        other = Guard()
        other.theirs = dict(self.theirs)
        return other

    def whole(self) -> "Guard":
        """Keep in the next block what takes longer, too: where an env or a controller is made."""
        self.count = len(SETTINGS)
        return self

    def __enter__(self) -> None:
        self.settings = [get() for get, _ in SETTINGS[: self.count]]
        for place, value in self.theirs.items():
            SETTINGS[place][1](value)
        self.numbers = _numbers()
        np.random.mtrand.set_bit_generator(self.bits)

    def __exit__(self, *_: object) -> None:
        bits, states, *python = self.numbers
        # A number that is drawn shows whether others were, in less time than a comparison.
        self.touched = (
            self.bits.random_raw() != self.same_bits.random_raw()
            or [_STATE.raw, _PYTHON.gauss_next] != python
            or list(map(_bytes, _of_torch())) != list(map(_bytes, states))
        )
        np.random.mtrand.set_bit_generator(bits)
        if self.touched:
            _set_numbers(self.numbers)
            self.bits, self.same_bits = np.random.MT19937(0), np.random.MT19937(0)
        now = [get() for get, _ in SETTINGS[: len(self.settings)]]
        if now != self.settings:
            self._restore(now)
        self.count = QUICK if not self.theirs else len(SETTINGS)

    def _restore(self, now: list[Any]) -> None:
        for place, (before, after) in enumerate(zip(self.settings, now, strict=True)):
            if after == before:
                continue
            SETTINGS[place][1](before)
            if place < KEPT:
                self.theirs[place] = after


class Held:
    """Hooks of a guide of other people: a guard around its calls, and random numbers of its own.

    The numbers are a part of the state of the guide.

    Args:
        guide: the guide.
    """

    def __init__(self, guide: TensorDictModuleBase) -> None:
        self.guard = Guard()
        self.numbers: Numbers | None = None  # not seeded yet
        guide.register_forward_pre_hook(self.before)
        guide.register_forward_hook(self.after, always_call=True)
        # Not the method itself: torch sets an attribute of the hook.
        guide.register_state_dict_post_hook(partial(self.save))
        guide.register_load_state_dict_pre_hook(self.load)

    def before(self, *_: object) -> None:
        """Begin a block, but where a call is traced: that has no effect on the process."""
        if torch.compiler.is_compiling():
            return
        if self.numbers is None:
            self.numbers = Numbers(torch.initial_seed())
        self.guard.__enter__()
        self.numbers.__enter__()

    def after(self, *_: object) -> None:
        """End the block."""
        if self.numbers is not None and not torch.compiler.is_compiling():
            self.numbers.__exit__()
            self.guard.__exit__()

    def save(self, _: object, state: dict[str, Any], prefix: str, *__: object) -> None:
        """Add the numbers to the state of the guide, if it uses any."""
        if self.numbers is not None and self.numbers.used:
            state[f"{prefix}{NUMBERS}"] = self.numbers.state_dict()

    def load(self, _: object, state: dict[str, Any], prefix: str, *__: object) -> None:
        """Take the numbers out of a state."""
        self.numbers = Numbers(torch.initial_seed())
        self.numbers.load_state_dict(state.pop(f"{prefix}{NUMBERS}", {}))


def hold(guide: TensorDictModuleBase) -> TensorDictModuleBase:
    """Keep from the process what a guide does to it, unless it is one of this package."""
    if type(guide).__module__.partition(".")[0] != "coil_rl":
        Held(guide)
    return guide
