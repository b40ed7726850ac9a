"""Processes that each step some rows of a batch of envs.

A plant that takes a millisecond a step keeps one core busy while the others wait. Here the rows are
spread over processes: each makes its own rows and keeps them, takes actions and returns the entries
of its rows. The seeds of the episodes are drawn by the batch itself, so the digits are those of one
process.

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
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from multiprocessing.connection import Connection, wait
from multiprocessing.util import Finalize, register_after_fork
from typing import Any

import torch
from numpy.typing import NDArray

from coil_rl.foreign.faults import ForeignError
from coil_rl.foreign.rows import Entries, GymnasiumRows

AUTO = "auto"
SAVED = 2e-3  # seconds; a batched step of this length pays for the messages
LEAST_STEPS, MOST_STEPS, LONGEST = 5, 30, 0.05  # of a timing, in steps and seconds
FIRST = 10  # priority of what ends the processes, at the end of the program
PATIENCE = 5.0  # seconds between two messages while processes start, and until one must have ended
# Signals that are meant for the program: it saves its state, and then ends its processes itself.
IGNORED = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1")

MakeRows = Callable[[range], GymnasiumRows]

_log = logging.getLogger(__name__)
_seconds: dict[str, float | None] = {}  # of a step of one row, by env


@dataclass
class _Reply:
    """What a process answers.

    Args:
        value: of the command.
        fault: of an env or controller, as one sentence.
        bug: a traceback, of anything else.
        warned: messages and categories of warnings.
    """

    value: Any = None
    fault: str = ""
    bug: str = ""
    warned: list[tuple[str, type[Warning]]] = field(default_factory=list)


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
    with suppress(OSError):  # one that has died is named later
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
        self.pipes: list[Connection] = []
        self.processes: list[Any] = []
        for own in self.ranges:
            pipe, process = _started(_serve, make, own)
            self.pipes.append(pipe)
            self.processes.append(process)
        _spread([process.pid for process in self.processes])
        # At the end of the program this runs before multiprocessing waits for its processes, which
        # do not end while their pipes are open.
        self._end = Finalize(self, _ended, (self.pipes, self.processes), exitpriority=FIRST)
        try:
            self._wait_until_ready()
        except BaseException:
            self.close()
            raise

    def _wait_until_ready(self) -> None:
        missing, began = list(self.pipes), time.monotonic()
        while missing:
            ready = wait(missing, PATIENCE)
            missing = [pipe for pipe in missing if pipe not in ready]
            if missing and time.monotonic() - began > PATIENCE:
                done = len(self.pipes) - len(missing)
                _log.info("env.workers: %d of %d processes are ready", done, len(self.pipes))
        self._gather()

    def begin(
        self, seeds: Mapping[int, int], actions: Mapping[int, Sequence[Any]]
    ) -> list[Entries]:
        """Begin episodes, take some actions in each, and return the entries of each process.

        Args:
            seeds: by row.
            actions: by row, as the env takes them; a row that is missing takes none.
        """
        for pipe, own in zip(self.pipes, self.ranges, strict=True):
            mine = {row - own.start: seed for row, seed in seeds.items() if row in own}
            theirs = {row - own.start: actions[row] for row in actions if row in own}
            self._send(pipe, ("begin", mine, theirs))
        return self._gather()

    def step(self, actions: Sequence[Any]) -> list[Entries]:
        """Take a step in all rows, and return the entries of each process.

        Args:
            actions: of all rows, as the env takes them.
        """
        for pipe, own in zip(self.pipes, self.ranges, strict=True):
            self._send(pipe, ("step", actions[own.start : own.stop]))
        return self._gather()

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

    def _reply(self, number: int) -> _Reply:
        try:
            reply: _Reply = self.pipes[number].recv()
        except (EOFError, OSError):
            return _Reply(fault=self._death(number))
        return reply

    def _value(self, reply: _Reply) -> Any:
        for text, category in reply.warned:
            warnings.warn(text, category, stacklevel=2)
        if reply.fault:
            raise ForeignError(reply.fault)
        if reply.bug:
            raise RuntimeError(f"a process of env.workers failed:\n{reply.bug}")
        return reply.value

    def _death(self, number: int) -> str:
        process, own = self.processes[number], self.ranges[number]
        process.join(PATIENCE)
        code = process.exitcode
        how = f"by signal {-code}" if code is not None and code < 0 else f"with exit code {code}"
        return (
            f"the process of env.workers that held the rows {own.start} to {own.stop - 1} of the "
            f"env {self.name} ended {how}; an env that needs too much memory or a crash in its "
            "own library does that: try env.workers=0"
        )


def choose(
    workers: int | str, rows: int, seconds: Callable[[], float | None], name: str, kind: str = ""
) -> int:
    """Return the number of processes for some rows; 0 for none besides this one.

    An env is timed once in a program.

    Args:
        workers: as a person gave it: a number, or "auto" for as many as there are cores if a step
            of all rows is long enough.
        seconds: gives the duration of a step of one row; None if it cannot be timed.
        kind: text that tells envs of one name apart.

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
    cores = min(_cores(), rows)
    # A process of a sweep has its share of the cores already.
    if not can_fork or cores < 2 or multiprocessing.parent_process() is not None:
        return 0
    known = f"{name} {kind}"
    first = known not in _seconds
    if first:
        _seconds[known] = seconds()
    each = _seconds[known]
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
    """Return the shortest seconds of a step of one row, but the first; None if it fails.

    They are those of the processor and what even the fastest step waits, so that the load of the
    machine decides nothing.
    """
    with warnings.catch_warnings(), suppress(Exception):  # the same fault follows where it is told
        warnings.simplefilter("ignore")
        shard, taken, waits = make(range(1)), list[float](), list[float]()
        shard.begin({0: 0}, {})
        shard.step([draw()])
        while len(taken) < MOST_STEPS and (
            len(taken) < LEAST_STEPS or sum(taken + waits) < LONGEST
        ):
            began, own = time.perf_counter(), time.process_time()
            (entries,) = shard.step([draw()])
            taken.append(time.process_time() - own)
            waits.append(time.perf_counter() - began - taken[-1])
            if entries["done"].any():
                shard.begin({0: len(taken)}, {})
        shard.close()
        return min(taken) + max(min(waits), 0.0)
    return None


def _cores() -> int:
    """Return the number of cores that this program may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _started(serve: Callable[..., None], *arguments: Any) -> tuple[Connection, Any]:
    """Fork a process; return this program's end of the pipe to it, and the process."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    # A pipe that another process holds open too would not say that its program has ended.
    register_after_fork(here, Connection.close)
    process = context.Process(target=_in_process, args=(serve, there, *arguments), daemon=True)
    with warnings.catch_warnings():
        # Newer Pythons warn of a fork beside threads; those here hold no lock that an env needs.
        warnings.simplefilter("ignore", DeprecationWarning)
        process.start()
    there.close()
    return here, process


def _in_process(serve: Callable[..., None], pipe: Connection, *arguments: Any) -> None:
    """Serve one pipe in a process that has just been forked."""
    for name in IGNORED:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    torch.set_num_threads(1)  # threads do not survive a fork
    serve(pipe, *arguments)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # what the program does at its end, such as on a GPU, is not for its copies


def _serve(pipe: Connection, make: MakeRows, own: range) -> None:
    """Make rows, and do what the batch asks of them until it closes the pipe."""
    reply, shard = _caught(lambda: make(own))
    with suppress(EOFError, OSError):  # the batch has ended
        pipe.send(_Reply(None, reply.fault, reply.bug, reply.warned))
        while shard is not None:
            name, *arguments = pipe.recv()
            reply, _ = _caught(lambda: _done(shard, name, arguments))  # noqa: B023
            pipe.send(reply)
    if shard is not None:
        shard.close()


def _done(shard: GymnasiumRows, name: str, arguments: Sequence[Any]) -> Any:
    if name == "picture":
        return shard.picture(*arguments)
    (entries,) = shard.begin(*arguments) if name == "begin" else shard.step(*arguments)
    return entries


def _caught(call: Callable[[], Any]) -> tuple[_Reply, Any]:
    """Return the reply for a call, and its value."""
    reply, value = _Reply(), None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        try:
            reply.value = value = call()
        except ValueError as error:
            reply.fault = str(error)
        except Exception:
            reply.bug = traceback.format_exc()
    reply.warned = [(str(each.message), each.category) for each in caught]
    return reply, value


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
