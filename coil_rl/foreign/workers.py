"""Processes that each step some rows of a batch of envs.

An env that takes a millisecond a step keeps one core busy while the others wait. Here the rows are
spread over processes: each makes its own rows and keeps them, takes actions and returns the entries
of its rows. The seeds of the episodes are drawn by the batch itself, so the numbers are those of
one process.

The processes are forked, so that envs and controllers need not be pickled. They are made before any
of their rows, and a row is only ever used in one process.
"""

import logging
import multiprocessing
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from itertools import pairwise
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize, register_after_fork
from typing import Any

import torch
from numpy.typing import NDArray

from coil_rl.foreign.faults import ForeignError
from coil_rl.foreign.guard import SIGNALS
from coil_rl.foreign.rows import Entries, GymnasiumRows

AUTO = "auto"
SAVED = 2e-3  # seconds; a batched step of this length pays for the messages
LEAST_STEPS, MOST_STEPS, LONGEST = 5, 30, 0.05  # of a timing, in steps and seconds
FIRST = 10  # exit priority: from 0 on it is before multiprocessing waits for its processes
PATIENCE = 5.0  # seconds until a process must have ended

MakeRows = Callable[[range], GymnasiumRows]
# What a process answers: a value, or an error in its place, and warnings.
Reply = tuple[Any, Exception | None, list[tuple[str, type[Warning]]]]

_log = logging.getLogger(__name__)


def _spread(pids: Sequence[int]) -> None:
    """Bind processes to a core each, if there is one for each of them and no other.

    They wait between two steps of the batch, and then the system may wake two of them on one core.
    Fewer processes than cores are left free, because another program may bind its own.
    """
    if sys.platform != "linux":
        return
    cores = sorted(os.sched_getaffinity(0))
    if len(pids) != len(cores):
        return
    with suppress(OSError):  # a process has died: its missing answer is an error later
        for pid, core in zip(pids, cores, strict=True):
            os.sched_setaffinity(pid, {core})


class Workers:
    """Processes that hold the rows of a batch between them.

    Args:
        make: makes the rows of a range, in the process that keeps them.
        rows: number of rows.
        count: number of processes, at most that of the rows.
        name: of the env, for messages.

    Raises:
        ForeignError: for a fault of an env or a controller, and for a process that died.
    """

    def __init__(self, make: MakeRows, rows: int, count: int, name: str) -> None:
        edges = [rows * number // count for number in range(count + 1)]
        self.ranges = [range(*pair) for pair in pairwise(edges)]
        self.name = name
        started = [_started(make, own) for own in self.ranges]
        self.pipes = [pipe for pipe, _ in started]
        self.processes = [process for _, process in started]
        _spread([process.pid for process in self.processes])
        # At the end of the program this runs before multiprocessing waits for its processes, which
        # do not end while their pipes are open.
        self._end = Finalize(self, _ended, (self.pipes, self.processes), exitpriority=FIRST)
        try:
            self._gather()  # they are ready
        except BaseException:
            self.close()
            raise

    def begin(
        self, seeds: Mapping[int, int], actions: Mapping[int, Sequence[Any]]
    ) -> list[Entries]:
        """Begin episodes, see `Rows`."""
        for pipe, own in zip(self.pipes, self.ranges, strict=True):
            mine = {row - own.start: seed for row, seed in seeds.items() if row in own}
            theirs = {row - own.start: actions[row] for row in actions if row in own}
            self._send(pipe, ("begin", mine, theirs))
        return [entries for part in self._gather() for entries in part]

    def step(self, actions: Sequence[Any]) -> list[Entries]:
        """Take a step in all rows, see `Rows`."""
        for pipe, own in zip(self.pipes, self.ranges, strict=True):
            self._send(pipe, ("step", actions[own.start : own.stop]))
        return [entries for part in self._gather() for entries in part]

    def picture(self, row: int) -> NDArray[Any]:
        """Return a picture of a row."""
        number = next(number for number, own in enumerate(self.ranges) if row in own)
        self._send(self.pipes[number], ("picture", row - self.ranges[number].start))
        picture: NDArray[Any] = self._value(self._reply(number))
        return picture

    def close(self) -> None:
        """End all processes."""
        self._end()

    def _send(self, pipe: Connection, command: tuple[Any, ...]) -> None:
        with suppress(OSError):  # of a process that died; its missing answer says so
            pipe.send(command)

    def _gather(self) -> list[Any]:
        """Return the answers of all processes; those after a fault are read too."""
        replies = [self._reply(number) for number in range(len(self.pipes))]
        return [self._value(reply) for reply in replies]

    def _reply(self, number: int) -> Reply:
        with suppress(EOFError, OSError):  # of a process that died
            reply: Reply = self.pipes[number].recv()
            return reply
        process, own = self.processes[number], self.ranges[number]
        process.join(PATIENCE)
        code = process.exitcode
        how = f"by signal {-code}" if code is not None and code < 0 else f"with exit code {code}"
        error = ForeignError(
            f"the process of env.workers that held the rows {own.start} to {own.stop - 1} of the "
            f"env {self.name} ended {how}; an env that needs too much memory or a crash in its "
            "own library does that: try env.workers=0"
        )
        return None, error, []

    def _value(self, reply: Reply) -> Any:
        value, error, warned = reply
        for text, category in warned:
            warnings.warn(text, category, stacklevel=2)
        if error is not None:
            raise error
        return value


def choose(
    workers: int | str,
    rows: int,
    seconds: Callable[[], float | None],
    name: str,
    known: dict[str, float | None],
    kind: str = "",
) -> int:
    """Return the number of processes for some rows; 0 for none besides this one.

    Args:
        workers: as a person gave it: a number, or "auto" for as many as there are cores if a step
            of all rows is long enough.
        seconds: gives the duration of a step of one row; None if it cannot be timed.
        known: these durations, by `kind`, which are measured once.
        kind: text that tells envs apart.

    Raises:
        ValueError: for a number of processes on a system that cannot fork.
    """
    can_fork = "fork" in multiprocessing.get_all_start_methods()
    if workers != AUTO:
        if workers and not can_fork:
            raise ValueError(
                f"workers={workers} needs processes that are forked, which this system does not "
                "have; leave it out"
            )
        count = min(int(workers), rows)
        return count if count > 1 else 0
    affinity = getattr(os, "sched_getaffinity", None)
    cores = min(len(affinity(0)) if affinity else os.cpu_count() or 1, rows)
    # A process of a sweep has its share of the cores already.
    if not can_fork or cores < 2 or multiprocessing.parent_process() is not None:
        return 0
    first = kind not in known
    if first:
        known[kind] = seconds()
    each = known[kind]
    if each is None:
        return 0
    count = cores if each * rows >= SAVED else 0
    if first:
        where = f"in {count} processes" if count else "in this process"
        _log.info(
            "env.workers=auto: %s takes %.2g ms a step, so %d rows are stepped %s",
            name,
            1000 * each,
            rows,
            where,
        )
    return count


def timed(make: MakeRows, draw: Callable[[], Any]) -> float | None:
    """Return the duration of a step of one row in seconds; None if a step fails.

    It is that of the shortest of some steps, which a busy machine changes little. The first step is
    left out.
    """
    with (
        warnings.catch_warnings(action="ignore"),
        suppress(Exception),  # the rows of the batch raise the same error
        closing(make(range(1))) as shard,
    ):
        taken = list[float]()
        shard.begin({0: 0}, {})
        shard.step([draw()])
        for number in range(MOST_STEPS):
            if number >= LEAST_STEPS and sum(taken) >= LONGEST:
                break
            began = time.perf_counter()
            (entries,) = shard.step([draw()])
            taken.append(time.perf_counter() - began)
            if entries["done"].any():
                shard.begin({0: len(taken)}, {})
        return min(taken)
    return None


def _started(make: MakeRows, own: range) -> tuple[Connection, Any]:
    """Fork a process; return this program's end of the pipe to it, and the process."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    # A pipe that another process holds open too would not say that its program has ended.
    register_after_fork(here, Connection.close)
    process = context.Process(target=_serve, args=(there, make, own), daemon=True)
    with warnings.catch_warnings():
        # Newer Pythons warn of a fork beside threads; those here hold no lock that an env needs.
        warnings.simplefilter("ignore", DeprecationWarning)
        process.start()
    there.close()
    return here, process


def _serve(pipe: Connection, make: MakeRows, own: range) -> None:
    """Make rows in a process that has just been forked, and do what the batch asks of them."""
    for number in SIGNALS:  # the program saves its state, and then ends its processes itself
        signal.signal(number, signal.SIG_IGN)
    torch.set_num_threads(1)  # threads do not survive a fork
    shard, *fault = _caught(make, own)
    with suppress(EOFError, OSError):  # the batch has ended
        pipe.send((None, *fault))
        while shard is not None:
            name, *arguments = pipe.recv()
            pipe.send(_caught(getattr(shard, name), *arguments))
    if shard is not None:
        shard.close()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # what the program does at its end, such as on a GPU, is not for its copies


def _caught(call: Callable[..., Any], *arguments: Any) -> Reply:
    """Return the reply for a call."""
    value: Any = None
    error: Exception | None = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        try:
            value = call(*arguments)
        except ValueError as fault:
            error = ForeignError(str(fault))
        except Exception:
            text = traceback.format_exc()
            error = RuntimeError(f"a process of env.workers failed:\n{text}")
    return value, error, [(str(each.message), each.category) for each in caught]


def _ended(pipes: Sequence[Connection], processes: Sequence[Any]) -> None:
    """Close pipes, which ends their processes; kill one that does not end."""
    for pipe in pipes:
        pipe.close()
    latest = time.monotonic() + PATIENCE  # of all together
    for process in processes:
        process.join(max(latest - time.monotonic(), 0))
        if process.is_alive():
            process.kill()
            process.join()
