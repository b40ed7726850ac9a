"""What all programs share: Hydra, and one sentence instead of a traceback for what a person got wrong."""

from __future__ import annotations

import functools
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import hydra
import yaml
from hydra._internal.utils import get_args_parser
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from coil_rl.errors import UserError
from coil_rl.programs.refusal import refuse
from coil_rl.train.check import check


def run(task: Callable[[DictConfig], Any], config_name: str, check: Callable[[DictConfig], None] = check) -> None:
    """Run a task under Hydra as a program, after a check of its configuration."""
    os.environ["HYDRA_FULL_ERROR"] = "1"
    logging.getLogger("hydra.utils").setLevel(logging.CRITICAL)  # it logs what it raises
    _check_options(config_name)
    of_task: list[Exception] = []

    @functools.wraps(task)
    def checked(config: DictConfig) -> Any:
        try:
            check(config)
            return task(config)
        except Exception as error:
            of_task.append(error)
            raise

    with program(config_name):
        try:
            hydra.main(version_base="1.3", config_path="pkg://coil_rl.conf", config_name=config_name)(checked)()
        except (HydraException, ValueError, OSError, yaml.YAMLError) as error:
            # Until the task runs there is only what was given to go wrong; in it, the same error is a bug of ours.
            if error in of_task:
                raise
            refuse(config_name, error)


@contextmanager
def program(name: str) -> Iterator[None]:
    """Around all that a process does: one sentence on standard error instead of a traceback.

    A mistake in what was given ends the process with exit code 2, Ctrl-C and SIGTERM with 130.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    try:
        yield
    except (UserError, OmegaConfBaseException) as error:
        refuse(name, error)
    except KeyboardInterrupt as stop:
        print(f"{name}: {'; '.join(['interrupted', *map(str, stop.args)])}", file=sys.stderr)
        sys.exit(130)


def _check_options(config_name: str) -> None:
    """Refuse unknown options, for which argparse would print its whole usage."""
    parser = get_args_parser()

    def error(message: str) -> None:
        refuse(config_name, UserError(f"{message}; options such as -m come first, then KEY=VALUE (see --hydra-help)"))

    vars(parser)["error"] = error
    for override in parser.parse_args().overrides:
        if override.startswith("="):
            error(f"{override!r} has no key, write KEY=VALUE")
