"""Timing on a noisy machine: alternating measurements, medians, and the time of single methods."""

from __future__ import annotations

import statistics
import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

Row = dict[str, Any]
Work = Callable[[], int]  # does a piece of work and returns its number of frames
Clock = Callable[[], float]


def clock_of(args: Namespace) -> Clock:
    """Return a clock that other processes do not disturb, where there is one."""
    alone = args.device == "cpu" and args.threads == 1
    return time.process_time if alone else time.perf_counter


def measure(
    args: Namespace, subjects: Mapping[str, Work], clock: Clock = time.perf_counter
) -> dict[str, list[float]]:
    """Return frames per second of each subject, one number for each of `args.repeats` rounds.

    In every round each subject has its turn, so a slow moment of the machine affects all of them. A
    turn is at least one call; all turns of a subject take about `args.seconds`. Each subject is
    called once before the first round.
    """
    for work in subjects.values():
        work()
    rates: dict[str, list[float]] = {name: [] for name in subjects}
    for _ in range(args.repeats):
        for name, work in subjects.items():
            synchronise()
            start, frames = clock(), 0
            while frames == 0 or clock() - start < args.seconds / args.repeats:
                frames += work()
            synchronise()
            rates[name].append(frames / (clock() - start))
    return rates


def medians(rates: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Return the median of each subject."""
    return {name: statistics.median(rounds) for name, rounds in rates.items()}


def median_ratio(over: Sequence[float], under: Sequence[float]) -> float:
    """Return the median of the ratios within each round, in which slow rounds cancel."""
    return statistics.median(a / b for a, b in zip(over, under, strict=True))


def synchronise() -> None:
    """Wait for the CUDA device, if it is in use."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


class Stopwatch:
    """Total time of methods by name.

    A timed method that another one calls counts for the outer one.

    Args:
        clock: returns seconds.
    """

    def __init__(self, clock: Clock = time.perf_counter) -> None:
        self.clock = clock
        self.seconds: dict[str, float] = {}
        self.running = False

    def wrap(self, owner: object, method: str, name: str) -> None:
        """Time all further calls of a method of one object.

        Args:
            name: under which its time is added up.
        """
        inner = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            if self.running:
                return inner(*args, **kwargs)
            synchronise()
            self.running, start = True, self.clock()
            result = inner(*args, **kwargs)
            synchronise()
            self.running = False
            self.seconds[name] = self.seconds.get(name, 0.0) + self.clock() - start
            return result

        owner.__dict__[method] = timed  # modules and envs override setattr
