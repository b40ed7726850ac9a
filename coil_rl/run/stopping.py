"""How a run is stopped by a signal, and by which command it goes on."""

import shlex
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType


class Stop:
    """Whether this process is asked to stop, by Ctrl-C, SIGTERM, SIGHUP or SIGUSR1.

    A training first ends its update and saves its state. Everything else is interrupted at once,
    and so is a training that is asked twice.

    Attributes:
        requested: whether it is asked.
        received: whether a signal came since a program began. It is remembered, because a module
            that is being imported may swallow a `KeyboardInterrupt`.
    """

    def __init__(self) -> None:
        self.requested, self.received, self._patient = False, False, False

    def ask(self) -> bool:
        """Ask to stop; return whether something runs that will stop by itself."""
        waits = self._patient and not self.requested
        self.requested = True
        return waits

    @contextmanager
    def after_update(self) -> Iterator[None]:
        """Say that what runs in the block stops by itself, also at Ctrl-C in a plain Python."""
        self.requested, before = False, self._patient
        self._patient = True
        is_plain = (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        )
        if is_plain:
            signal.signal(signal.SIGINT, self.interrupt)
        try:
            yield
        finally:
            self._patient = before
            if is_plain:
                signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupt(self, signum: int, frame: FrameType | None) -> None:
        """Raise a `KeyboardInterrupt` at a signal, unless something runs that stops by itself."""
        self.received = True
        if not self.ask():
            raise KeyboardInterrupt

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Interrupt what runs in the block."""
        before = self._patient
        self._patient = False
        try:
            yield
        finally:
            self._patient = before


STOP = Stop()


def command_of(program: str, key: str, folder: Path | str, trust: Sequence[str]) -> str:
    """Return the command that takes the folder of a run, as a shell reads it.

    Args:
        key: by which it takes it.
        trust: packages that it must trust.
    """
    words = [f"trust=[{','.join(trust)}]"] if trust else []
    return shlex.join([program, f"{key}={folder}", *words])


def resume_command(folder: Path, trust: Sequence[str]) -> str:
    """Return the command that continues a run, as a shell reads it."""
    return command_of("coil-train", "resume", folder, trust)
