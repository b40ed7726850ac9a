"""Frame of the console programs.

Hydra composes the configuration, and a mistake of the user becomes one sentence.

A program imports torch, and whatever imports it, inside its functions. Help texts and wrong
overrides then take a second:

    def train(config: DictConfig) -> float:
        from coil_rl.run.run import run

        return run(config)
"""

import contextlib
import functools
import logging
import math
import os
import re
import shlex
import shutil
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, NoReturn

import hydra
import yaml
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import coil_rl.config  # noqa: F401  registers the root configurations
from coil_rl import programs
from coil_rl.config.sentences import is_no_bug, sentence
from coil_rl.config.trust import trust_packages
from coil_rl.config.written import keep_written, key_of
from coil_rl.errors import RunningError, UserError
from coil_rl.files import FAILED_JOBS
from coil_rl.output import SafeStream, say
from coil_rl.programs.folders import spelled
from coil_rl.run.stopping import STOP

COMMON_KEYS = ("seed", "device", "threads", "trust", "run_dir")  # of all programs that drive
HYDRA_FILES = (
    "config.yaml",
    "hydra.yaml",
    "overrides.yaml",
)  # in the subfolder hydra.output_subdir of a job
_new_folders: list[Path] = []  # made for this run or sweep, the innermost first
_interrupts: list[int] = []  # signals of this program
_sweep: list[str] = []  # folder of the sweep of this program, if it is one
MOST_PROCESSES = 64  # of joblib, or four for each processor if those are more


class NoSweepError(UserError):
    """A program without sweeps was started with several values of a key; none of them is run."""


class NewFolders(Callback):
    """Record the folders that Hydra is about to make.

    It makes them before the configuration is checked.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Record the folder of a run."""
        _record(config, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Record the folder of a sweep, and say how it goes on if it is stopped."""
        _record(config, "hydra.sweep.dir")
        _sweep[:] = [str(config.hydra.sweep.dir)]
        Path(_sweep[0], FAILED_JOBS).unlink(missing_ok=True)
        if "existing" in config:  # the jobs are runs, which go on where they were stopped
            command = _sweep_command(sys.argv, _sweep[0])
            say(f"if this sweep is stopped, go on with: {command}", error=True)

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Record the folder of a job of a sweep."""
        folder = Path(config.hydra.runtime.output_dir)
        if folder.parent in _new_folders and folder not in _new_folders:
            _new_folders.insert(0, folder)


def _record(config: DictConfig, key: str) -> None:
    try:
        folder = Path(str(OmegaConf.select(config, key))).absolute()
        folder /= str(OmegaConf.select(config, "hydra.output_subdir") or "")
    except OmegaConfBaseException:
        return  # Hydra raises the same error next
    _new_folders[:] = _missing(folder)


def _missing(folder: Path) -> list[Path]:
    """Return what does not exist of a folder and those that it is in, the innermost first."""
    return [place for place in (folder, *folder.parents) if not os.path.exists(place)]


def overrides() -> list[tuple[str, str]]:
    """Return the full key and the text of each override on the command line."""
    return [(key_of(text), text) for text in typed().task]


class Typed(NamedTuple):
    """The arguments of the command line, as typed: references in them stay."""

    task: list[str]  # for the program
    hydra: list[str]  # for Hydra


def typed() -> Typed:
    """Return the arguments of the command line."""
    given: Any = OmegaConf.to_container(HydraConfig.get().overrides, resolve=False)
    return Typed(given["task"], given["hydra"])


def command_line() -> list[str]:
    """Return the command that makes this run alone, also where it is a job of a sweep."""
    if not HydraConfig.initialized():
        return []
    given = typed()
    # Files of another package, such as an experiment, are found only with this one.
    places = [word for word in given.hydra if word.startswith("hydra.searchpath=")]
    return ["coil-train", *places, *given.task]


def check_used(used: Iterable[str], reason: str) -> None:
    """Raise a `UserError` for an override that has no effect.

    `used` are the top-level keys that have one, besides those of every program that drives;
    `reason` is why others do not.
    """
    known = (*used, *COMMON_KEYS)
    for key, text in overrides():
        if re.split(r"[./]", key)[0] not in known:
            raise UserError(
                f"{text} has no effect: {reason}; what can be changed is {', '.join(known)}"
            )


def check_unused(node: str, unused: Iterable[str], reason: str) -> None:
    """Raise a `UserError` for an override in a node that has no effect.

    Args:
        node: top-level key, such as "evaluation".
        unused: keys in it that have none.
        reason: why they have none.
    """
    for key, text in overrides():
        first, *rest = key.split(".")
        if first == node and rest and rest[0] in unused:
            raise UserError(f"{text} has no effect: {reason}; leave it out")


def check_folder(key: str) -> None:
    """Raise a `UserError` for hydra.run.dir in a program whose files go elsewhere.

    Args:
        key: names the folder of the files.
    """
    for text in typed().hydra:
        if text.lstrip("+").startswith("hydra.run.dir="):
            raise UserError(f"{text} has no effect: the files are written to {key}=FOLDER")


def check_run(config: DictConfig) -> None:
    """Check everything that a run needs, unless it is finished.

    See `coil_rl.config.check.check`.
    """
    from coil_rl.config.saved import holds
    from coil_rl.run.folder import is_evaluated

    folder = Path(config.run_dir)
    if config.get("existing") == "resume" and is_evaluated(folder) and holds(folder, config):
        return
    from coil_rl.config.check import check

    check(config)


def run_program(
    task: Callable[[DictConfig], Any],
    config_name: str,
    check: Callable[[DictConfig], None] = check_run,
    config_path: str = "pkg://coil_rl.conf",
) -> None:
    """Run a task as a console program: Hydra composes its configuration, which is checked first.

    A mistake of the user ends the process with one sentence and exit code 2.

    Args:
        task: what the program does with its configuration.
        config_name: of the YAML file; also the name of the program.
        check: raises a `UserError` for a mistake in the configuration, before anything is done.
        config_path: where the YAML file is. One of another package, such as "pkg://my_package.conf",
            finds the files of coil-rl by its own `hydra: {searchpath: [pkg://coil_rl.conf]}`, and
            gets the help and the clean-up of these programs by the schema `ProgramConfig`.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"
    logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)  # it logs the errors that it raises
    _new_folders.clear()
    _interrupts.clear()
    _sweep.clear()
    bugs: list[Exception] = []
    jobs = Jobs(config_name)

    @functools.wraps(task)
    def checked(config: DictConfig) -> Any:
        try:
            return _do(task, check, config)
        except KeyboardInterrupt as error:
            if jobs.is_sweep():
                raise KeyboardInterrupt(f"continue with: {jobs.command}") from error
            raise
        except Exception as error:
            if jobs.is_sweep() and not isinstance(error, NoSweepError):
                return jobs.fail(error)
            if is_no_bug(error):
                # Here, because Hydra prints a line of its own for an error of the task.
                refuse(config_name, error)
            bugs.append(error)
            raise

    with program(config_name):
        sys.argv[1:] = map(spelled, sys.argv[1:])
        _check_options(config_name)
        try:
            hydra.main(version_base="1.3", config_path=config_path, config_name=config_name)(
                checked
            )()
        except (
            HydraException,
            ValueError,
            OSError,
            yaml.YAMLError,
            AssertionError,
            TypeError,
        ) as error:
            # Outside of the task these errors come from the command line and the configuration
            # files.
            if error in bugs:
                raise
            refuse(config_name, error)
        jobs.report()


def _do(
    task: Callable[[DictConfig], Any], check: Callable[[DictConfig], None], config: DictConfig
) -> Any:
    """Do a task after a check of its configuration, and return its result."""
    _listen()
    _draw_into_files()
    if Jobs.is_sweep() and "existing" in config:
        config.existing = "resume"  # so that a sweep goes on by the same command
    keep_written(config, str(HydraConfig.get().job.config_name), *typed())
    trust_packages(config.get("trust", []), config)
    if config.get("run_dir"):  # which the check makes, if it is not Hydra's own
        _new_folders[:0] = _missing(Path(config.run_dir).absolute())
    check(config)
    programs.imported()
    if _interrupts:
        raise KeyboardInterrupt
    return task(config)


@contextmanager
def program(name: str) -> Iterator[None]:
    """End the process with one sentence on standard error instead of a traceback.

    The exit code is 2 for a mistake of the user, and 130 for Ctrl-C, SIGTERM, SIGHUP and SIGUSR1.
    After one of the last three a training first ends its update and saves its state.
    """
    _listen()
    _draw_into_files()
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.formatwarning = lambda message, *_, **__: f"{name}: {message}\n"
    sys.stdout, sys.stderr = SafeStream(sys.stdout), SafeStream(sys.stderr)
    try:
        yield
    except (Exception, KeyboardInterrupt) as error:
        # A library may raise an error of its own on the way out of an interrupt.
        if _interrupts or isinstance(error, KeyboardInterrupt):
            reasons = map(str, error.args) if isinstance(error, KeyboardInterrupt) else ()
            print(f"{name}: {'; '.join(['interrupted', *reasons])}", file=sys.stderr)
            sys.exit(130)
        if not is_no_bug(error):
            raise
        refuse(name, error)
    finally:
        sys.stdout, sys.stderr = _end(sys.stdout), _end(sys.stderr)


def _end(stream: Any) -> Any:
    """Return the stream in a `SafeStream`; one that is broken would change the exit code."""
    if not isinstance(stream, SafeStream):
        return stream
    stream.flush()
    return open(os.devnull, "w", encoding="utf-8") if stream.broken else stream.stream


def _listen() -> None:
    """Handle signals, in this process or in that of a job of a sweep."""
    if threading.current_thread() is not threading.main_thread():
        return  # other threads cannot
    if signal.getsignal(signal.SIGINT) is programs.interrupted:
        signal.signal(signal.SIGINT, _interrupt)
    for name in ("SIGTERM", "SIGHUP", "SIGUSR1"):  # the last two are missing on Windows
        number = getattr(signal, name, None)
        # A program under nohup ignores SIGHUP.
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _interrupt)


def _draw_into_files() -> None:
    """Choose a backend for matplotlib that needs no window and no notebook, in this process.

    `MPLBACKEND` may name one that does not exist here: a notebook sets it for all that it starts,
    and matplotlib ends its import with an error.
    """
    os.environ["MPLBACKEND"] = "agg"


def _interrupt(signum: int, frame: FrameType | None) -> None:
    """Raise a `KeyboardInterrupt`, unless a training ends its update first.

    It is remembered, because a module that is being imported may swallow it.
    """
    _interrupts.append(signum)
    if signum == signal.SIGINT or not STOP.ask():
        raise KeyboardInterrupt


class Jobs:
    """The jobs of a sweep, which may run in other processes.

    One that fails leaves the others alone.

    A job that fails writes a line into a file in the folder of the sweep.

    Args:
        name: of the program.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.arguments = list(sys.argv)  # those of a process of its own are others

    @staticmethod
    def is_sweep() -> bool:
        """Return whether this is a job of a sweep."""
        return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN

    @property
    def command(self) -> str:
        """The command that continues the sweep, as a shell reads it."""
        return _sweep_command(self.arguments, HydraConfig.get().sweep.dir)

    def fail(self, error: Exception) -> float:
        """Note that a job failed, and return NaN, its result.

        A job whose run another process is working on has not failed: it is left to that process,
        so that several programs can share a sweep.

        Args:
            error: a mistake of the user, or a bug, whose traceback is printed.
        """
        hydra_config = HydraConfig.get()
        job = f"job {hydra_config.job.num} ({' '.join(hydra_config.overrides.task)})"
        if isinstance(error, RunningError):
            say(f"{self.name}: {job} is left to the process that works on it", error=True)
            return math.nan
        reason = sentence(error)
        if not is_no_bug(error):
            traceback.print_exception(error)
            reason = f"{type(error).__name__}: {reason}"
        line = f"{job}: {reason}"
        say(f"{self.name}: {line}; the other jobs go on", error=True)
        with contextlib.suppress(OSError):  # it is empty
            Path(hydra_config.runtime.output_dir).rmdir()
        path = Path(hydra_config.sweep.dir, FAILED_JOBS)
        # Another program of the same sweep, all of whose jobs failed, may have removed the folder.
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")
        return math.nan

    def report(self) -> None:
        """End the program with exit code 2 if jobs have failed."""
        path = Path(_sweep[0], FAILED_JOBS) if _sweep else None
        if path is None or not path.is_file():
            return
        # Several programs may do the same sweep, and a job fails in each of them.
        lines = list(dict.fromkeys(path.read_text(encoding="utf-8").splitlines()))
        count = "1 job" if len(lines) == 1 else f"{len(lines)} jobs"
        refuse(
            self.name,
            UserError(
                f"{count} of this sweep failed: {_by_reason(lines)}; correct the cause, and do "
                f"what is missing by {_sweep_command(self.arguments, _sweep[0])}"
            ),
        )


def _by_reason(lines: Sequence[str]) -> str:
    """Return the lines of failed jobs in one, each reason once.

    Args:
        lines: such as "job 0 (method=ppo seed=0): the env ...".
    """
    jobs: dict[str, list[str]] = {}
    for line in lines:
        job, _, reason = line.partition("): ")
        jobs.setdefault(reason, []).append(f"{job})")
    parts = []
    for reason, failed in jobs.items():
        numbers = ", ".join(job.split()[1] for job in failed)
        parts.append(f"{failed[0]}: {reason}" if len(failed) == 1 else f"jobs {numbers}: {reason}")
    return "; ".join(parts)


def _sweep_command(arguments: Sequence[str], folder: str) -> str:
    """Return the command that continues a sweep, as a shell reads it.

    Args:
        arguments: of the program that began it, its own path first.
        folder: of the sweep.
    """
    program, *others = arguments
    if not any(argument.startswith("hydra.sweep.dir=") for argument in others):
        others.append(f"hydra.sweep.dir={folder}")
    return shlex.join([f"coil-{Path(program).stem.removeprefix('coil-')}", *others])


def refuse(name: str, error: Exception) -> NoReturn:
    """End the program with one sentence and exit code 2.

    New folders that hold no files of the task are removed.
    """
    for folder in filter(os.path.exists, _new_folders):  # a name may be too long for one
        inside = {path for path in folder.rglob("*") if not path.is_dir()}
        of_jobs = set()
        for path in inside:
            if path.name == "hydra.yaml":
                of_jobs |= {path.with_name(file) for file in HYDRA_FILES}
        of_sweep = ("multirun.yaml", FAILED_JOBS)
        if all(path.name in of_sweep or path in of_jobs for path in inside):
            shutil.rmtree(folder, ignore_errors=True)
    _new_folders.clear()
    print(f"{name}: {sentence(error)}", file=sys.stderr)
    sys.exit(2)


def _check_options(config_name: str) -> None:
    """Refuse unknown options, for which argparse would print its whole usage."""
    parser = get_args_parser()

    def error(message: str) -> None:
        refuse(
            config_name,
            UserError(f"{message}; options such as -m come first, then KEY=VALUE (see --help)"),
        )

    vars(parser)["error"] = error
    for override in parser.parse_args().overrides:
        if override.startswith("="):
            error(f"{override!r} has no key, write KEY=VALUE")
        jobs = re.fullmatch(r"\+*hydra\.launcher\.n_jobs=(-?\d+)", override)
        most = max(MOST_PROCESSES, 4 * (os.cpu_count() or 1))
        if jobs and abs(int(jobs[1])) > most:
            error(f"{override} must be at most {most} on this machine")
