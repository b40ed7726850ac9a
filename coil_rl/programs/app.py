"""What all programs share: Hydra, and one sentence instead of a traceback for what a person got wrong."""

from __future__ import annotations

import functools
import logging
import os
import sys
from collections.abc import Callable
from typing import Any, NoReturn

import hydra
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from coil_rl import config as _schema  # noqa: F401  registers the typed roots
from coil_rl.errors import UserError


def run(task: Callable[[DictConfig], Any], config_name: str) -> None:
    """Run a task under Hydra; exit code 2 and one sentence on standard error for a mistake in what was given."""
    os.environ["HYDRA_FULL_ERROR"] = "1"
    logging.getLogger("torchrl").setLevel(logging.WARNING)

    def refuse(error: Exception) -> NoReturn:
        print(f"{config_name}: {_sentence(error)}", file=sys.stderr)
        sys.exit(2)

    @functools.wraps(task)
    def politely(config: DictConfig) -> Any:
        # Here and not outside, where Hydra would have put a line of its own before the sentence.
        try:
            return task(config)
        except (UserError, OmegaConfBaseException) as error:
            refuse(error)

    try:
        hydra.main(version_base="1.3", config_path="pkg://coil_rl.conf", config_name=config_name)(politely)()
    except (HydraException, OmegaConfBaseException) as error:
        refuse(error)
    except KeyboardInterrupt:
        print(f"{config_name}: interrupted", file=sys.stderr)
        sys.exit(130)


def _sentence(error: BaseException) -> str:
    """The message on one line, with the cause that Hydra hides behind it."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    cause = error.__cause__
    if cause is not None and not isinstance(error, UserError) and str(cause).splitlines()[0] not in lines:
        lines.append(str(cause).splitlines()[0])
    return " ".join(line for line in lines if not line.startswith(("full_key:", "object_type=", "reference_type=")))
