"""Sweeps: how they go on, and how a job that fails leaves the others alone."""

import contextlib
import math
import os
import shlex
import shutil
import sys
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig

from coil_rl.config.messages import reason_of, refuse
from coil_rl.errors import RunningError, UserError, file_of_a_run
from coil_rl.files import FAILED_JOBS, SWEEP
from coil_rl.output import say
from coil_rl.plain_yaml import read_yaml

MOST_JOBS = 10_000  # of a word of a sweep that are counted


class Sweep(Callback):
    """Print the command that continues a sweep before it, and after it which jobs failed."""

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Print the command that continues the sweep."""
        if "existing" in config:  # the jobs are runs, which go on where they were stopped
            command = command_of(sys.argv, config.hydra.sweep.dir)
            say(f"if this sweep is stopped, go on with: {command}", error=True)
            HydraConfig.instance().set_config(config)  # for an interrupt outside of a job
        Path(config.hydra.sweep.dir, FAILED_JOBS).unlink(missing_ok=True)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """End the program with exit code 2 if jobs have failed."""
        folder = Path(config.hydra.sweep.dir)
        if not (folder / FAILED_JOBS).is_file():
            if "existing" in config:
                say(f"Next: {shlex.join(['coil-report', f'folder={folder}'])}")
            return
        # Several programs may do the same sweep, and a job fails in each of them.
        lines = dict.fromkeys((folder / FAILED_JOBS).read_text(encoding="utf-8").splitlines())
        remove_unused(folder)
        count = "1 job" if len(lines) == 1 else f"{len(lines)} jobs"
        refuse(
            str(config.hydra.job.name),
            UserError(
                f"{count} of this sweep failed: {_by_reason(list(lines))}; correct the cause, and "
                f"do what is missing by {command_of(sys.argv, str(folder))}"
            ),
        )


def remove_unused(folder: Path) -> None:
    """Remove the folder of a sweep none of whose jobs has begun."""
    of_sweep = (SWEEP, FAILED_JOBS)
    if all(path.is_dir() or path.name in of_sweep for path in folder.rglob("*")):
        shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # others are in it
            if not folder.is_absolute():
                os.removedirs(folder.parent)


def unstarted_jobs(folders: Iterable[Path], runs: Iterable[Path]) -> int:
    """Return the number of jobs that sweeps in some folders have not begun.

    Args:
        runs: folders of all that were begun.
    """
    begun = [run.resolve() for run in runs]
    files = {path.resolve() for folder in folders for path in folder.rglob(SWEEP)}
    jobs = {path.parent: _jobs_of_sweep(path) for path in sorted(files)}
    return sum(
        max(count - sum(folder in run.parents for run in begun), 0)
        for folder, count in jobs.items()
    )


def _jobs_of_sweep(path: Path) -> int:
    """Return the number of jobs of the sweep of a file of Hydra, 0 where it is not known."""
    with file_of_a_run(path, "remove it"):
        node = read_yaml(path)["hydra"]
        if not node["sweeper"]["_target_"].endswith(".BasicSweeper"):
            return 0  # others choose their jobs as they go
        own = [f"{key}={value}" for key, value in (node["sweeper"].get("params") or {}).items()]
        try:
            parsed = OverridesParser.create().parse_overrides([*own, *node["overrides"]["task"]])
            # A word of the command counts in place of one of the sweep's file.
            last = {each.key_or_group: each for each in parsed}.values()
            swept = [each.sweep_iterator() for each in last if each.is_sweep_override()]
            return math.prod(sum(1 for _ in islice(values, MOST_JOBS)) for values in swept)
        except HydraException as error:
            raise ValueError(str(error)) from error


def is_sweep() -> bool:
    """Return whether this is a job of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def failed(name: str, error: Exception) -> float:
    """Note that a job of a sweep failed, and return NaN, its result: the others go on.

    A job whose run another process is working on has not failed: it is left to that process, so
    that several programs can share a sweep.

    Args:
        name: of the program.
        error: a mistake of the user, or a bug, whose traceback is printed.
    """
    hydra_config = HydraConfig.get()
    job = f"job {hydra_config.job.num} ({' '.join(hydra_config.overrides.task)})"
    if isinstance(error, RunningError):
        say(f"{name}: {job} is left to the process that works on it", error=True)
        return math.nan
    line = f"{job}: {reason_of(error)}"
    say(f"{name}: {line}; the other jobs go on", error=True)
    with contextlib.suppress(OSError):  # it is empty
        Path(hydra_config.runtime.output_dir).rmdir()
    path = Path(hydra_config.sweep.dir, FAILED_JOBS)
    # Another program of the same sweep, all of whose jobs failed, may have removed the folder.
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(f"{line}\n")
    return math.nan


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


def command_of(arguments: Sequence[str], folder: str) -> str:
    """Return the command that continues a sweep, as a shell reads it.

    Args:
        arguments: of the program that began it, its own path first.
    """
    program, *others = arguments
    if not any(argument.startswith("hydra.sweep.dir=") for argument in others):
        others.append(f"hydra.sweep.dir={folder}")
    return shlex.join([f"coil-{Path(program).stem.removeprefix('coil-')}", *others])
