"""Guard of the settings and global random numbers of the process against foreign code.

An env that seeds torch would make the exploration noise of all its episodes equal, one that changes
the folder would break the paths of the run. So foreign code has its own: what it sets holds when it
is called again, and what the process had is back after each call.
"""

import _signal  # type: ignore[import-not-found]
import ctypes
import logging
import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
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

# The generator of NumPy in the process, the states of those of NumPy in foreign code and of Python,
# and of torch.
GlobalNumbers = tuple[Any, list[bytes], float | None, list[Tensor]]


def _in_place(address: int) -> Any:
    """Return the state of a generator in its own memory: 624 numbers of four bytes, and an index.

    It is valid as long as the generator lives. What NumPy and Python give takes a hundred times as
    long, because they make an object of each number.
    """
    return (ctypes.c_char * (4 * 625)).from_address(address)


def _of_numpy(bits: np.random.MT19937) -> Any:
    return _in_place(bits.ctypes.state_address)


def _of_python(generator: random.Random) -> Any:
    return _in_place(id(generator) + object.__basicsize__)


_FOREIGN = np.random.MT19937(0)  # that of NumPy in foreign code
_BEGINNING = _of_numpy(_FOREIGN).raw
_PYTHON: Any = random._inst  # that of the process
_STATES = [_of_numpy(_FOREIGN), _of_python(_PYTHON)]


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


def _set_handler(number: int, handler: Any) -> None:
    # None is one that C code has set; other threads cannot set any.
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(number, handler)


# What reads a setting of the process, and what sets it.
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
    (sys.getrecursionlimit, sys.setrecursionlimit),
    (torch.are_deterministic_algorithms_enabled, torch.use_deterministic_algorithms),
    (torch.get_float32_matmul_precision, torch.set_float32_matmul_precision),
]
KEPT = len(SETTINGS)  # but of handlers: without ours a Ctrl-C would be missed
# `signal.getsignal` takes a hundred times as long.
SETTINGS += [
    (partial(_signal.getsignal, number), partial(_set_handler, number)) for number in SIGNALS
]


class Numbers:
    """The global random numbers of torch, NumPy and Python, as foreign code sees them in a block.

    They belong to a row, or to a controller, and are seeded. So rows are separate in any number of
    processes, also if they seed the process, and one that draws without a seed can be repeated.
    Code that does not use them in its first calls is left with those of the process, which takes no
    time; `Guard` notices when it does later.

    Args:
        seed: any whole number.
    """

    def __init__(self, seed: int = 0) -> None:
        self.watched, self.used = WATCHED, False
        self.before: GlobalNumbers | None = None
        self.seed(seed)

    @property
    def active(self) -> bool:
        """Whether a call needs these numbers, or it is not known yet."""
        return self.used or self.watched > 0

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
        numpy, python = np.random.MT19937(seed), random.Random(seed)
        states = [_of_numpy(numpy).raw, _of_python(python).raw]
        self.own: GlobalNumbers = (
            _FOREIGN,
            states,
            None,
            [torch.Generator().manual_seed(seed).get_state()],
        )

    def __enter__(self) -> None:
        if self.active:
            self.before = _numbers()
            _set_numbers(self.own)

    def __exit__(self, *_: object) -> None:
        if self.before is None:
            return
        first, self.own = self.own, _numbers()
        _set_numbers(self.before)
        self.before = None
        if not self.used:
            self.watched -= 1
            self.used = _content(self.own) != _content(first)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the generators as plain values; empty if they are not used."""
        _, states, gauss, of_torch = self.own
        return {"states": states, "gauss": gauss, "torch": of_torch} if self.used else {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what `state_dict` returned."""
        if state:
            self.used = True
            self.own = _FOREIGN, state["states"], state["gauss"], state["torch"]


def _numbers() -> GlobalNumbers:
    """Return the present states of the generators."""
    states = [torch.default_generator.get_state()]
    if torch.cuda.is_initialized():
        states += [generator.get_state() for generator in torch.cuda.default_generators]
    bits = np.random.mtrand.get_bit_generator()
    return bits, [each.raw for each in _STATES], _PYTHON.gauss_next, states


def _set_numbers(numbers: GlobalNumbers) -> None:
    bits, states, _PYTHON.gauss_next, of_torch = numbers
    np.random.mtrand.set_bit_generator(bits)
    for place, raw in zip(_STATES, states, strict=True):
        place.raw = raw
    torch.default_generator.set_state(of_torch[0])
    for generator, state in zip(torch.cuda.default_generators, of_torch[1:], strict=False):
        generator.set_state(state)


def _content(numbers: GlobalNumbers) -> list[Any]:
    """Return what tells states of generators apart."""
    _, states, gauss, of_torch = numbers
    # Sooner than by NumPy.
    return [*states, gauss, *(ctypes.string_at(each.data_ptr(), each.numel()) for each in of_torch)]


class Guard:
    """Keeps from the process what foreign code does to it in a block: a batch of calls.

    Attributes:
        touched: whether the last block has used the numbers of the process.
    """

    def __init__(self) -> None:
        self.theirs: dict[int, Any] = {}  # what the foreign code has set, by its place in SETTINGS
        self.touched = False

    def __deepcopy__(self, memo: Any) -> "Guard":
        """Return a guard with what foreign code has set; what the process has is not copied."""
        other = Guard()
        other.theirs = dict(self.theirs)
        return other

    def __enter__(self) -> None:
        self.settings = [get() for get, _ in SETTINGS]
        for place, value in self.theirs.items():
            SETTINGS[place][1](value)
        self.numbers = _numbers()
        np.random.mtrand.set_bit_generator(_FOREIGN)
        _STATES[0].raw = _BEGINNING

    def __exit__(self, *_: object) -> None:
        _, *python = _content(self.numbers)
        self.touched = _content(_numbers()) != [_BEGINNING, *python]
        _set_numbers(self.numbers)
        now = [get() for get, _ in SETTINGS]
        places = range(len(now)) if now != self.settings else ()
        changed = {place: now[place] for place in places if now[place] != self.settings[place]}
        for place in changed:
            SETTINGS[place][1](self.settings[place])
        self.theirs = {place: changed[place] for place in changed if place < KEPT}


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
