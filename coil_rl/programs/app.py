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
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

import coil_rl.config  # noqa: F401  registers the root configurations
from coil_rl import programs
from coil_rl.config.compose import check_values, keep_written, key_of, typed
from coil_rl.config.folder import make_folder
from coil_rl.config.messages import is_no_bug, naming_files, refuse
from coil_rl.config.trust import trust_own, trust_packages
from coil_rl.errors import NO_SPACE, UserError
from coil_rl.output import SafeStream
from coil_rl.plain_yaml import is_part
from coil_rl.programs.folders import spelled
from coil_rl.programs.sweeps import command_of, failed, is_sweep, remove_unused
from coil_rl.run.stopping import STOP

COMMON_KEYS = ("seed", "device", "threads", "trust", "run_dir")  # of all programs that drive


def listen() -> None:
    """Hand signals to `STOP`, in this process or in that of a job of a sweep."""
    if threading.current_thread() is not threading.main_thread():
        return  # other threads cannot
    if signal.getsignal(signal.SIGINT) is programs.interrupted:
        signal.signal(signal.SIGINT, STOP.interrupt)
    for name in ("SIGTERM", "SIGHUP", "SIGUSR1"):  # the last two are missing on Windows
        number = getattr(signal, name, None)
        # A program under nohup ignores SIGHUP.
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, STOP.interrupt)


class OwnFolder(Callback):
    """Keep the folder of a run from Hydra, which makes it before the configuration is checked.

    While Hydra makes folders it is the working folder; the program makes its own after the check.
    """

    def __init__(self) -> None:
        self.folder = ""  # none in a sweep, whose folders are Hydra's

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Take the folder out of the configuration."""
        with contextlib.suppress(OmegaConfBaseException):  # Hydra raises the same error next
            self.folder = os.path.abspath(str(config.hydra.run.dir))
            self._set(config, ".")

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Put it back, before the program begins."""
        if self.folder:
            self._set(config, self.folder)
            config.hydra.runtime.output_dir = self.folder
            HydraConfig.instance().set_config(config)

    @staticmethod
    def _set(config: DictConfig, folder: str) -> None:
        OmegaConf.set_readonly(config.hydra, False)
        config.hydra.run.dir, config.hydra.output_subdir = folder, None


def overrides() -> list[tuple[str, str]]:
    """Return the full key and the text of each override on the command line."""
    return [(key_of(text), text) for text in typed(HydraConfig.get())[0]]


def command_line() -> list[str]:
    """Return the command that makes this run alone, also where it is a job of a sweep."""
    if not HydraConfig.initialized():
        return []
    task, of_hydra = typed(HydraConfig.get())
    # Files of another package, such as an experiment, are found only with this one.
    places = [word for word in of_hydra if word.startswith("hydra.searchpath=")]
    return ["coil-train", *places, *task]


def check_used(used: Iterable[str], reason: str) -> None:
    """Raise a `UserError` for an override that has no effect.

    Args:
        used: full keys that have one with all that is in them, besides those of every program that
            drives.
        reason: why others have none.
    """
    known = (*used, *COMMON_KEYS)
    for key, text in overrides():
        if not is_part(key, known):
            raise UserError(
                f"{text} has no effect: {reason}; what can be changed is {', '.join(known)}"
            )


def check_unused(unused: Iterable[str], reason: str) -> None:
    """Raise a `UserError` for an override that has no effect.

    Args:
        unused: full keys that have none with all that is in them.
        reason: why they have none.
    """
    for key, text in overrides():
        if is_part(key, unused):
            raise UserError(f"{text} has no effect: {reason}; leave it out")


def check_folder(key: str) -> None:
    """Raise a `UserError` for hydra.run.dir in a program whose files go elsewhere.

    Args:
        key: names the folder of the files.
    """
    for text in typed(HydraConfig.get())[1]:
        if text.lstrip("+").startswith("hydra.run.dir="):
            raise UserError(f"{text} has no effect: the files are written to {key}=FOLDER")


def run_program(
    task: Callable[[DictConfig], Any],
    config_name: str,
    check: Callable[[DictConfig], None],
    config_path: str = "pkg://coil_rl.conf",
    further: Callable[[list[str]], list[str]] | None = None,
    no_sweep: str = "",
) -> None:
    """Run a task as a console program: Hydra composes its configuration, which is checked first.

    A mistake of the user ends the process with one sentence and exit code 2.

    Args:
        task: what the program does with its configuration, with the number of threads of that.
        config_name: of the YAML file; also the name of the program.
        check: raises a `UserError` for a mistake in the configuration, before anything is done. Its
            values are those of the schema.
        config_path: where the YAML file is. One of another package, such as "pkg://my_package.conf",
            finds the files of coil-rl by an entry point, see `coil_rl.config.schema`, and
            gets the help and the clean-up of these programs by the schema `ProgramConfig`.
        further: returns the words that a command line leaves open.
        no_sweep: the sentence that refuses a sweep, of a program that has none.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"
    bugs: list[Exception] = []

    @functools.wraps(task)
    def checked(config: DictConfig) -> Any:
        if no_sweep and is_sweep():
            remove_unused(Path(HydraConfig.get().sweep.dir))
            refuse(config_name, UserError(no_sweep))
        try:
            return _do(task, check, config)
        except Exception as error:
            if is_sweep():
                return failed(config_name, error)
            if is_no_bug(error):
                # Here, because Hydra prints a line of its own for an error of the task.
                refuse(config_name, error)
            bugs.append(error)
            raise

    with program(config_name):
        sys.argv[1:] = map(spelled, sys.argv[1:])
        texts = [n for n, word in enumerate(sys.argv) if "=" in word and word[0] != "-"]
        place = texts[-1] + 1 if texts else len(sys.argv)  # options may follow, such as --cfg job
        sys.argv[place:place] = further(sys.argv[1:]) if further else []
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


def _do(
    task: Callable[[DictConfig], Any],
    check: Callable[[DictConfig], None],
    config: DictConfig,
) -> Any:
    """Do a task after a check of its configuration, and return its result."""
    listen()
    _draw_into_files()
    if is_sweep() and "existing" in config:
        config.existing = "resume"  # so that a sweep goes on by the same command
    files = keep_written(config, HydraConfig.get())
    trust_packages(config.get("trust", []))
    trust_own(config)
    has_folder = bool(config.get("run_dir"))
    made = _missing(Path(config.run_dir).absolute()) if has_folder else []
    try:
        with naming_files(files):
            check_values(config)
            check(config)
            if has_folder:
                make_folder(Path(config.run_dir))
            if STOP.received:
                raise KeyboardInterrupt
            if "threads" in config:
                import torch

                torch.set_num_threads(config.threads)
            return task(config)
    except Exception:
        for folder in made:
            with contextlib.suppress(OSError):  # it is not empty, or was not made
                folder.rmdir()
        raise


def _missing(folder: Path) -> list[Path]:
    """Return what does not exist of a folder and those that it is in, the innermost first."""
    return [place for place in (folder, *folder.parents) if not os.path.exists(place)]


@contextmanager
def program(name: str) -> Iterator[None]:
    """End the process with one sentence on standard error instead of a traceback.

    The exit code is 2 for a mistake of the user, and 130 for Ctrl-C, SIGTERM, SIGHUP and SIGUSR1.
    A training first ends its update and saves its state; a second signal ends it at once.

    Args:
        name: of the program.
    """
    STOP.received = False
    listen()
    _draw_into_files()
    warnings.formatwarning = _saying_once(name)
    threading.excepthook = _end_of_thread
    out = SafeStream(sys.stdout)
    sys.stdout, sys.stderr = out, SafeStream(sys.stderr)
    try:
        yield
        _check_written(name, out)
    except SystemExit as end:  # such as after a help text
        if not end.code:
            _check_written(name, out)
        raise
    except (Exception, KeyboardInterrupt) as error:
        # A library may raise an error of its own on the way out of an interrupt.
        if STOP.received or isinstance(error, KeyboardInterrupt):
            args = error.args if isinstance(error, KeyboardInterrupt) else ()
            reasons = [str(each) for each in args]
            if is_sweep():
                command = command_of(sys.argv, HydraConfig.get().sweep.dir)
                reasons = [f"continue with: {command}"]
            print(f"{name}: {'; '.join(['interrupted', *reasons])}", file=sys.stderr)
            sys.exit(130)
        if not is_no_bug(error):
            raise
        refuse(name, error)
    finally:
        sys.stdout, sys.stderr = _end(sys.stdout), _end(sys.stderr)


def plain_program(name: str, usage: str, task: Callable[[list[str]], None]) -> None:
    """Run a task as a console program that takes its arguments as they are, without Hydra.

    Args:
        name: of the program.
        usage: what is printed where help is asked for.
        task: what the program does with its arguments.
    """
    arguments = sys.argv[1:]
    if any(argument in ("-h", "--help") for argument in arguments):
        print(usage)
        return
    with program(name):
        task(arguments)


def _saying_once(name: str) -> Callable[..., str]:
    """Return what makes a line of a warning, nothing of one that was said before.

    Python does so too, but begins anew where code of somebody else sets filters at each step.

    Args:
        name: of the program.
    """
    said = set[str]()

    def line(message: Warning | str, *_: object, **__: object) -> str:
        text = f"{name}: {message}\n"
        is_new = text not in said
        said.add(text)
        return text if is_new else ""

    return line


def _check_written(name: str, out: SafeStream) -> None:
    """End the program with an error code if its text met a full disk."""
    out.flush()
    if out.full is not None:
        refuse(name, out.full)


def _end_of_thread(error: Any) -> None:
    """Print the uncaught error of a thread, unless the disk is full.

    The thread of a logger meets a full disk, and the next call of the logger raises the same error.

    Args:
        error: as of `threading.excepthook`.
    """
    if getattr(error.exc_value, "errno", None) not in NO_SPACE:
        threading.__excepthook__(error)


def _end(stream: Any) -> Any:
    """Return the stream in a `SafeStream`; one that is broken would change the exit code."""
    if not isinstance(stream, SafeStream):
        return stream
    stream.flush()
    return open(os.devnull, "w", encoding="utf-8") if stream.broken else stream.stream


def _draw_into_files() -> None:
    """Choose a backend for matplotlib that needs no window and no notebook, in this process.

    `MPLBACKEND` may name one that does not exist here: a notebook sets it for all that it starts,
    and matplotlib ends its import with an error.
    """
    os.environ["MPLBACKEND"] = "agg"


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
