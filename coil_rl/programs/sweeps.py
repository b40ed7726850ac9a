"""Sweeps: what they are going to do, and how a job that fails leaves the others alone."""

import contextlib
import math
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.compose import keep_written
from coil_rl.config.messages import reason_of, refuse
from coil_rl.errors import RunningError, UserError
from coil_rl.files import FAILED_JOBS
from coil_rl.output import progress, say


class Plan(Callback):
    """Say before a sweep what it is going to do, and after it which of its jobs failed.

    A sweep, or a run, is refused in an env that its experiment is not made for.

    Args:
        only_in: classes of envs, one of which the env of the sweep must be; empty for any env.
        because: why other envs cannot be used, and what to do instead.
        unless: group of files that bring their env, so that a choice of one allows any env; empty:
            there is none.
    """

    def __init__(self, only_in: Sequence[str] = (), because: str = "", unless: str = "") -> None:
        self.only_in, self.because, self.unless = tuple(only_in), because, unless

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Refuse an env that the experiment is not made for."""
        self._check(config)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Refuse what the runs cannot use, and say how many there are and what some do not read."""
        if "existing" in config:  # the jobs are runs, which go on where they were stopped
            self._check(config)
            runs: list[DictConfig] = []
            # Hydra raises the errors of the composition next.
            with contextlib.suppress(HydraException, OmegaConfBaseException, UserError):
                runs.extend(_planned(config))
            if len(runs) > 1:
                say(described(list(map(_frames_of, runs))), error=True)
            if runs:
                _check_words(config, runs)
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

    def _check(self, config: DictConfig) -> None:
        target = OmegaConf.select(config, "env._target_", throw_on_missing=False)
        if not self.only_in or target in self.only_in or not isinstance(target, str):
            return
        if self.unless and self.unless in config.hydra.runtime.choices:
            return
        with contextlib.suppress(ImportError, ValueError):  # no such env, which the check refuses
            if _derives(get_object(target), self.only_in):
                return
            choices = config.hydra.runtime.choices
            refuse(
                str(config.hydra.job.name),
                UserError(
                    f"experiment={choices.get('experiment')} cannot be used with "
                    f"env={choices.get('env')}: {self.because}"
                ),
            )


def _derives(target: Any, bases: Sequence[str]) -> bool:
    """Return whether a class derives from one of several, which are named."""
    return isinstance(target, type) and issubclass(target, tuple(map(get_object, bases)))


def described(frames: Sequence[int]) -> str:
    """Return how many runs and frames of training a sweep has.

    Args:
        frames: of each run; 0 for one without training.
    """
    trained = sorted({each for each in frames if each})
    each = ""
    if len(trained) == 1:
        each = f", {trained[0]:_} each"
    elif trained:
        each = f", {trained[0]:_} to {trained[-1]:_} each"
    return (
        f"this sweep has {len(frames)} runs with {sum(frames):_} frames of training in all{each}; "
        "budget.frames=NUMBER changes it"
    )


def knows_all_runs(sweeper: DictConfig) -> bool:
    """Return whether a sweeper makes all combinations, so that the runs of a sweep are known."""
    return str(sweeper.get("_target_")).endswith(BasicSweeper.__name__)


def _planned(config: DictConfig) -> Iterator[DictConfig]:
    """Yield the configuration of each run of a sweep, if Hydra's own sweeper makes it.

    Runs that differ by their seed only are composed once, and are the same object.
    """
    if not knows_all_runs(config.hydra.sweeper):
        return
    loader: Any = GlobalHydra.instance().config_loader()
    parser = OverridesParser.create(config_loader=loader)
    [jobs] = BasicSweeper.split_arguments(parser.parse_overrides(_words(config)), None)
    known: dict[tuple[str, ...], DictConfig] = {}
    for job in progress(iterable=jobs, unit="job", desc="check", leave=False, delay=2):
        key = tuple(word for word in job if not word.startswith("seed="))
        if key not in known:
            known[key] = _composed(loader, config, job)
        yield known[key]


def _words(config: DictConfig) -> list[str]:
    """Return the words of a sweep for the program, those of its experiment first."""
    params = config.hydra.sweeper.get("params") or {}
    return [*(f"{key}={value}" for key, value in params.items()), *_plain(config, "task")]


def _composed(loader: Any, config: DictConfig, job: Sequence[str]) -> DictConfig:
    """Return the configuration of a job of a sweep."""
    composed: DictConfig = loader.load_sweep_config(config, list(job))
    keep_written(composed, composed.hydra, job, _plain(config, "hydra"))
    return composed


def _frames_of(run: DictConfig) -> int:
    """Return the frames of training of a run, 0 for a method without an agent."""
    return 0 if run.method.observes is None else int(run.budget.frames)


def _check_words(config: DictConfig, runs: Sequence[DictConfig]) -> None:
    """Refuse a word that no run of a sweep reads, and say which ones only some of them read."""
    from coil_rl.config.unread import check_sweep  # imports torch

    try:
        sentences = check_sweep(_words(config), runs)
    except UserError as error:
        refuse(str(config.hydra.job.name), error)
    for said in sentences:
        say(said, error=True)


def _plain(config: DictConfig, kind: str) -> list[str]:
    """Return the overrides of the command line, for the program ("task") or for Hydra."""
    texts: Any = OmegaConf.to_container(config.hydra.overrides[kind], resolve=False)
    return list(texts)


def remove_unused(folder: Path) -> None:
    """Remove the folder of a sweep none of whose jobs has begun."""
    of_sweep = ("multirun.yaml", FAILED_JOBS)
    if all(path.is_dir() or path.name in of_sweep for path in folder.rglob("*")):
        shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # others are in it
            if not folder.is_absolute():
                os.removedirs(folder.parent)


def is_sweep() -> bool:
    """Return whether this is a job of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


class Jobs:
    """The jobs of a sweep, which may run in other processes.

    One that fails leaves the others alone.

    A job that fails writes a line into a file in the folder of the sweep.

    Args:
        name: of the program.
    """

    def __init__(self, name: str) -> None:
        self.name = name

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
        line = f"{job}: {reason_of(error)}"
        say(f"{self.name}: {line}; the other jobs go on", error=True)
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
    if "evaluate" in program:  # adds the signs itself
        others = [re.sub(r"^\+\+(env\.(info|workers)=)", r"\1", each) for each in others]
    if not any(argument.startswith("hydra.sweep.dir=") for argument in others):
        others.append(f"hydra.sweep.dir={folder}")
    return shlex.join([f"coil-{Path(program).stem.removeprefix('coil-')}", *others])
