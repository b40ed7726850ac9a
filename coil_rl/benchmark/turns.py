"""Fair clocks for noisy machines: what is compared takes turns, and medians over the rounds are reported."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch

Rates = dict[str, list[float]]


@dataclass(frozen=True)
class Turns:
    """How long and how often to measure.

    Args:
        seconds: of each subject, all its turns together; a turn is at least one call.
        repeats: turns of each subject.
        device: waited for at both ends of a turn.
        tick: called with the name of what is measured now.
        clock: in seconds; `time.process_time` leaves out what other processes take.
    """

    seconds: float
    repeats: int
    device: str
    tick: Callable[[str], Any] = lambda _: None
    clock: Callable[[], float] = time.perf_counter

    def rates(self, subjects: Mapping[str, Callable[[], int]], label: str = "") -> Rates:
        """Frames per second of each subject, one number a round.

        Args:
            subjects: from name to a function that does a piece of work and returns its frames. Each is called once
                before the clock starts.
            label: put before the names for `tick`.
        """
        rates: Rates = {name: [] for name in subjects}
        for name, work in subjects.items():
            self.tick(f"{label}{name}, warm-up")
            work()
        for _ in range(self.repeats):
            for name, work in subjects.items():
                self.tick(f"{label}{name}")
                rates[name].append(self._rate(work))
        return rates

    def _rate(self, work: Callable[[], int]) -> float:
        synchronise(self.device)
        start, frames = self.clock(), 0
        while frames == 0 or self.clock() - start < self.seconds / self.repeats:
            frames += work()
        synchronise(self.device)
        return frames / (self.clock() - start)


def synchronise(device: str) -> None:
    """Wait for everything a CUDA device was told to do."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()


def median_ratio(over: Sequence[float], under: Sequence[float]) -> float:
    """Median of the ratios within each round: what slows a whole round down cancels."""
    return statistics.median(a / b for a, b in zip(over, under, strict=True))


class Sections:
    """Where the time of a program goes: each section is charged for what no section inside it is.

    Args:
        device: waited for at both ends of each section, so that on CUDA the parts add up but the whole is slower.
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}
        self._open: list[str] = []
        self._since = 0.0

    def wrap(self, owner: object, method: str, name: str) -> None:
        """Time a method of one object, from now on."""
        inner = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.section(name):
                return inner(*args, **kwargs)

        # Not setattr: modules and envs have ideas of their own about that.
        owner.__dict__[method] = timed

    @contextmanager
    def section(self, name: str) -> Iterator[None]:
        """Charge what happens inside to `name`."""
        self._charge()
        self._open.append(name)
        try:
            yield
        finally:
            self._charge()
            self._open.pop()

    def _charge(self) -> None:
        synchronise(self.device)
        now = time.perf_counter()
        if self._open:
            self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._since
        self._since = now
