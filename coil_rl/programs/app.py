"""Frame of the console programs: Hydra composes the configuration, and a mistake of the user becomes one sentence.

A program imports torch, and whatever imports it, inside its functions. Help texts and wrong
overrides then take a second:

    def train(config: DictConfig) -> float:
        from coil_rl.run.run import run

        return run(config)
"""

import functools
import logging
import os
import re
import shutil
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

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
from coil_rl.config.sentences import is_no_bug, sentence
from coil_rl.config.trust import trust_packages
from coil_rl.errors import UserError
from coil_rl.programs.folders import spelled

COMMON_KEYS = ("seed", "device", "threads", "trust", "run_dir")  # of all programs that drive
HYDRA_FILES = (
    "config.yaml",
    "hydra.yaml",
    "overrides.yaml",
)  # in the subfolder hydra.output_subdir of a job
_new_folders: list[Path] = []  # made by Hydra for this run or sweep, the innermost first
_interrupts: list[int] = []  # signals of this program


class NewFolders(Callback):
    """Record the folders that Hydra is about to make, because it makes them before the configuration is checked."""

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Record the folder of a run."""
        _record(config, "hydra.run.dir")

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Record the folder of a sweep."""
        _record(config, "hydra.sweep.dir")

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
    _new_folders[:] = [place for place in (folder, *folder.parents) if not os.path.exists(place)]


def overrides() -> list[tuple[str, str]]:
    """Return the full key and the text of each override on the command line."""
    texts = HydraConfig.get().overrides.task
    return [(text.lstrip("+~").partition("=")[0].rpartition("@")[2], text) for text in texts]


def command_line() -> list[str]:
    """Return the command that makes this run alone, also where it is a job of a sweep."""
    if not HydraConfig.initialized():
        return []
    return ["coil-train", *HydraConfig.get().overrides.task]


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


def check_run(config: DictConfig) -> None:
    """Check everything that a run needs, unless it is finished; see `coil_rl.config.check.check`."""
    from coil_rl.config.saved import holds
    from coil_rl.run.folder import is_evaluated

    folder = Path(config.run_dir)
    if config.get("existing") == "resume" and is_evaluated(folder) and holds(folder, config):
        return
    from coil_rl.config.check import check

    check(config)


def run(
    task: Callable[[DictConfig], Any],
    config_name: str,
    check: Callable[[DictConfig], None] = check_run,
) -> None:
    """Run a task as a program after a check of its configuration; `config_name` is also the name of the program."""
    os.environ["HYDRA_FULL_ERROR"] = "1"
    logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)  # it logs the errors that it raises
    _new_folders.clear()
    _interrupts.clear()
    bugs: list[Exception] = []

    @functools.wraps(task)
    def checked(config: DictConfig) -> Any:
        try:
            trust_packages(config.get("trust", []), config)
            check(config)
            if _interrupts:
                raise KeyboardInterrupt
            return task(config)
        except Exception as error:
            if is_no_bug(error):
                refuse(
                    config_name, error
                )  # here, because Hydra prints a line of its own for an error of the task
            bugs.append(error)
            raise

    with program(config_name):
        sys.argv[1:] = map(spelled, sys.argv[1:])
        _check_options(config_name)
        try:
            hydra.main(
                version_base="1.3", config_path="pkg://coil_rl.conf", config_name=config_name
            )(checked)()
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


@contextmanager
def program(name: str) -> Iterator[None]:
    """End the process with one sentence on standard error instead of a traceback.

    The exit code is 2 for a mistake of the user, and 130 for Ctrl-C and SIGTERM.
    """
    if signal.getsignal(signal.SIGINT) is programs.interrupted:
        signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.formatwarning = lambda message, *_, **__: f"{name}: {message}\n"
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


def _interrupt(signum: int, frame: FrameType | None) -> NoReturn:
    """Raise a `KeyboardInterrupt`, and remember it, because a module that is being imported may swallow it."""
    _interrupts.append(signum)
    raise KeyboardInterrupt


def refuse(name: str, error: Exception) -> NoReturn:
    """End the program with one sentence and exit code 2, and remove new folders that hold no files of the task."""
    for folder in filter(os.path.exists, _new_folders):  # a name may be too long for one
        inside = {path for path in folder.rglob("*") if not path.is_dir()}
        of_jobs = {
            path.with_name(name)
            for path in inside
            if path.name == "hydra.yaml"
            for name in HYDRA_FILES
        }
        if all(path.name == "multirun.yaml" or path in of_jobs for path in inside):
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
