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
from collections.abc import Callable, Mapping, Sequence
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
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")
LOGGERS = (logging.root, logging.getLogger("coil_rl"))
# Python's global generator, and its state in place: an index and 624 numbers of four bytes. Its
# `getstate` takes fifty times as long, because it makes an object of each number.
_PYTHON: Any = random._inst
_STATE: Any = (ctypes.c_char * (4 * 625)).from_address(id(_PYTHON) + object.__basicsize__)


def _folder() -> str | None:
    try:
        return os.getcwd()
    except OSError:  # it was removed
        return None


def _go_to(folder: str | None) -> None:
    with suppress(OSError):
        if folder is not None:
            os.chdir(folder)


def _logging() -> tuple[int, ...]:
    root, own = LOGGERS
    return root.manager.disable, root.level, own.level


def _set_logging(levels: tuple[int, ...]) -> None:
    logging.disable(levels[0])
    for logger, level in zip(LOGGERS, levels[1:], strict=True):
        logger.setLevel(level)


def _warnings() -> tuple[Any, ...]:
    return warnings.filters[:], warnings.showwarning, warnings.formatwarning


def _set_warnings(state: tuple[Any, ...]) -> None:
    filters, warnings.showwarning, warnings.formatwarning = state
    with warnings.catch_warnings():  # its end makes Python look at the new filters
        pass
    warnings.filters[:] = filters  # type: ignore[index]


def _printing() -> tuple[Any, ...]:
    return np.get_printoptions(), np.geterr(), vars(tensor_str.PRINT_OPTS).copy()


def _set_printing(state: tuple[Any, ...]) -> None:
    options, errors, of_torch = state
    np.set_printoptions(**options)
    np.seterr(**errors)
    vars(tensor_str.PRINT_OPTS).update(of_torch)


def _computing() -> tuple[bool, bool]:
    return torch.is_grad_enabled(), torch.is_autocast_enabled("cpu")


def _set_computing(state: tuple[bool, bool]) -> None:
    grad, autocast = state
    torch._C._set_grad_enabled(grad)
    torch.set_autocast_enabled("cpu", autocast)


def _device() -> torch.device | None:
    return _torch_device.CURRENT_DEVICE  # `torch.get_default_device` takes eighty times as long


def _set_path(folders: list[str]) -> None:
    sys.path[:] = folders


def _set_recursion(limit: int) -> None:
    with suppress(RecursionError):  # one that is reached already
        sys.setrecursionlimit(limit)


def _set_streams(streams: tuple[Any, ...]) -> None:
    sys.stdout, sys.stderr = streams


def _handlers() -> list[Any]:
    return [signal.getsignal(getattr(signal, name)) for name in SIGNALS if hasattr(signal, name)]


def _set_handlers(handlers: list[Any]) -> None:
    if threading.current_thread() is not threading.main_thread():
        return  # other threads cannot
    numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
    for number, handler in zip(numbers, handlers, strict=True):
        if handler is not None:  # one that C code has set
            signal.signal(number, handler)


# What reads a setting of the process, and what sets it. The first ones take a microsecond.
SETTINGS: list[tuple[Callable[[], Any], Callable[[Any], Any]]] = [
    (_folder, _go_to),
    (torch.get_default_dtype, torch.set_default_dtype),
    (_computing, _set_computing),
    (torch.get_num_threads, torch.set_num_threads),
    (_logging, _set_logging),
    (_warnings, _set_warnings),
    (_printing, _set_printing),
    (lambda: (sys.stdout, sys.stderr), _set_streams),
    (_device, torch.set_default_device),
    (lambda: sys.path[:], _set_path),
    (sys.getrecursionlimit, _set_recursion),
]
QUICK = len(SETTINGS)
SETTINGS += [
    (torch.are_deterministic_algorithms_enabled, torch.use_deterministic_algorithms),
    (torch.get_float32_matmul_precision, torch.set_float32_matmul_precision),
    (_handlers, _set_handlers),
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
        self.bits: Any = np.random.MT19937(seed)
        self.states = [torch.Generator().manual_seed(seed).get_state()]
        self.python = random.Random(seed).getstate()

    def __enter__(self) -> None:
        self.before = np.random.mtrand.get_bit_generator(), _of_torch(), random.getstate()
        self.first = {} if self.used else self.bits.state["state"]
        np.random.mtrand.set_bit_generator(self.bits)
        _set_torch(self.states)
        random.setstate(self.python)

    def __exit__(self, *_: object) -> None:
        states, python = _of_torch(), random.getstate()
        if not self.used:
            self.watched -= 1
            key, at = (self.bits.state["state"][name] for name in ("key", "pos"))
            self.used = not (
                at == self.first["pos"]
                and np.array_equal(key, self.first["key"])
                and _equal(states, self.states)
                and python == self.python
            )
        self.states, self.python = states, python
        np.random.mtrand.set_bit_generator(self.before[0])
        _set_torch(self.before[1])
        random.setstate(self.before[2])

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the generators as plain values; empty if they are not used."""
        if not self.used:
            return {}
        numpy = self.bits.state["state"]
        key, pos = numpy["key"].tolist(), int(numpy["pos"])
        return {"torch": self.states, "python": self.python, "numpy": [key, pos]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        if not state:
            return
        self.used = True
        version, numbers, gauss = state["python"]
        self.states, self.python = list(state["torch"]), (version, tuple(numbers), gauss)
        key, pos = state["numpy"]
        inner = {"key": np.array(key, np.uint32), "pos": pos}
        self.bits = np.random.MT19937()
        self.bits.state = {"bit_generator": "MT19937", "state": inner}


def _of_torch() -> list[Tensor]:
    """Return the states of torch's generators, of the CPU first."""
    states = [torch.default_generator.get_state()]
    if torch.cuda.is_initialized():
        states += [generator.get_state() for generator in torch.cuda.default_generators]
    return states


def _set_torch(states: Sequence[Tensor]) -> None:
    torch.default_generator.set_state(states[0])
    for generator, state in zip(torch.cuda.default_generators, states[1:], strict=False):
        generator.set_state(state)


def _equal(states: Sequence[Tensor], others: Sequence[Tensor]) -> bool:
    """Return whether states have the same bytes."""
    return [_bytes(state) for state in states] == [_bytes(state) for state in others]


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
        self.numbers = np.random.mtrand.get_bit_generator(), _of_torch(), _STATE.raw
        self.gauss = _PYTHON.gauss_next
        np.random.mtrand.set_bit_generator(self.bits)

    def __exit__(self, *_: object) -> None:
        bits, of_torch, python = self.numbers
        np.random.mtrand.set_bit_generator(bits)
        # A number that is drawn shows whether others were, in less time than a comparison.
        self.touched = (
            self.bits.random_raw() != self.same_bits.random_raw()
            or _STATE.raw != python
            or not _equal(_of_torch(), of_torch)
        )
        if self.touched:
            _STATE.raw, _PYTHON.gauss_next = python, self.gauss
            _set_torch(of_torch)
            self.bits, self.same_bits = np.random.MT19937(0), np.random.MT19937(0)
        now = [get() for get, _ in SETTINGS[: len(self.settings)]]
        if now != self.settings:
            self._restore(now)
        self.count = QUICK if not self.theirs else len(SETTINGS)

    def _restore(self, now: list[Any]) -> None:
        for place, (before, after) in enumerate(zip(self.settings, now, strict=True)):
            if after == before:
                continue
            put = SETTINGS[place][1]
            put(before)
            if put is not _set_handlers:  # without ours a Ctrl-C would be missed
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
