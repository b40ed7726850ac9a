"""What a sweep is going to do: its runs, their frames and time, and the words that they read."""

import contextlib
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
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

from coil_rl.config.written import Job, keep_written
from coil_rl.errors import UserError
from coil_rl.output import say
from coil_rl.programs.app import refuse

TIMED = 5.0  # s of training, at least, from which the time of a sweep is estimated
UPDATES = 8  # at least
BASIC = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"  # one job after the other
_frames: list[int] = []  # of each run of the sweep of this program
_said: list[str] = []  # folders of the sweeps whose time was estimated


class Plan(Callback):
    """Say before a sweep how many runs it has, or refuse it in an env that it is not made for.

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
        _frames.clear()
        _said.clear()
        if "existing" not in config:  # the jobs are no runs
            return
        self._check(config)
        runs: list[Job] = []
        # Hydra raises the errors of the composition next.
        with contextlib.suppress(HydraException, OmegaConfBaseException, UserError):
            runs.extend(_planned(config))
        _frames.extend(map(_frames_of, runs))
        if len(_frames) > 1:
            say(described(_frames), error=True)
        if runs:
            _check_words(config, runs)

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
    """Return whether a sweeper makes all combinations, so that the runs of a sweep are known.

    Args:
        sweeper: the node of Hydra.
    """
    return str(sweeper.get("_target_")).endswith(BasicSweeper.__name__)


def _planned(config: DictConfig) -> Iterator[Job]:
    """Yield each run of a sweep, if Hydra's own sweeper makes it.

    Runs that differ by their seed only are composed once.
    """
    if not knows_all_runs(config.hydra.sweeper):
        return
    loader: Any = GlobalHydra.instance().config_loader()
    parser = OverridesParser.create(config_loader=loader)
    [jobs] = BasicSweeper.split_arguments(parser.parse_overrides(_words(config)), None)
    known: dict[tuple[str, ...], Job] = {}
    for job in jobs:
        key = tuple(word for word in job if not word.startswith("seed="))
        if key not in known:
            known[key] = Job(key, _composed(loader, config, job))
        yield known[key]


def _words(config: DictConfig) -> list[str]:
    """Return the words of a sweep for the program, those of its experiment first."""
    params = config.hydra.sweeper.get("params") or {}
    return [*(f"{key}={value}" for key, value in params.items()), *_plain(config, "task")]


def _composed(loader: Any, config: DictConfig, job: Sequence[str]) -> DictConfig:
    """Return the configuration of a job of a sweep."""
    composed: DictConfig = loader.load_sweep_config(config, list(job))
    name = str(config.hydra.job.config_name)
    keep_written(composed, name, job, _plain(config, "hydra"))
    return composed


def _frames_of(job: Job) -> int:
    """Return the frames of training of a run, 0 for a method without an agent."""
    return 0 if job.config.method.observes is None else int(job.config.budget.frames)


def _check_words(config: DictConfig, runs: Sequence[Job]) -> None:
    """Refuse a word that no run of a sweep reads, and say which ones only some of them read."""
    from coil_rl.config.unread import check_sweep  # imports torch

    # A run that differs from another one by its seed only is the same object.
    different = list({id(run): run for run in runs}.values())
    try:
        sentences = check_sweep(_words(config), different)
    except UserError as error:
        refuse(str(config.hydra.job.name), error)
    for sentence in sentences:
        say(sentence, error=True)


def _plain(config: DictConfig, kind: str) -> list[str]:
    """Return the overrides of the command line, for the program ("task") or for Hydra."""
    texts: Any = OmegaConf.to_container(config.hydra.overrides[kind], resolve=False)
    return list(texts)


class Pace:
    """Estimates the time of a sweep by the first seconds of a training; a callback of a run.

    Args:
        frames: of each update.
    """

    names: Sequence[str] = ()

    def __init__(self, frames: int) -> None:
        self.frames = frames
        self.last: float | None = None  # time of the last update
        self.seconds: list[float] = []  # of each update

    def due(self, update: int, updates: int, row: Mapping[str, float]) -> bool:
        """Return whether the time of this sweep was not estimated yet."""
        return not _said

    def after_update(self, update: int) -> dict[str, float]:
        """Estimate the time as soon as a few seconds and updates of training are over.

        Args:
            update: number of updates so far.
        """
        now = time.monotonic()
        if self.last is not None:
            self.seconds.append(now - self.last)
        self.last = now
        if sum(self.seconds) >= TIMED and len(self.seconds) >= UPDATES:
            # The first updates may take much longer: machine code is made in them.
            a_frame = statistics.median(self.seconds) / self.frames
            _said.append(HydraConfig.get().sweep.dir)
            say(f"\n{estimated(a_frame, _frames)}", error=True)
        return {}


def pace(config: DictConfig) -> Pace | None:
    """Return the callback that estimates the time of a sweep, for the jobs that may say it.

    Where jobs run side by side, that is the first one.
    """
    if not HydraConfig.initialized():
        return None
    hydra_config = HydraConfig.get()
    if hydra_config.mode != RunMode.MULTIRUN:
        return None
    alone = hydra_config.launcher.get("_target_") == BASIC
    if not alone and hydra_config.job.num != 0:
        return None
    return Pace(config.budget.num_envs * config.budget.steps)


def estimated(a_frame: float, frames: Sequence[int]) -> str:
    """Return how long a sweep takes at the pace of its first run.

    Args:
        a_frame: seconds of training for a frame.
        frames: of each run; empty if unknown, as in a process that does a part of the jobs.
    """
    if not frames:
        return (
            f"at this pace 100,000 frames of training take about {duration(a_frame * 100_000)}, "
            "and the evaluations come on top"
        )
    return (
        f"at this pace the training of all {len(frames)} runs takes about "
        f"{duration(a_frame * sum(frames))}, one after the other; other methods have another pace, "
        "and the evaluations come on top"
    )


def duration(seconds: float) -> str:
    """Return a duration in words, rounded: 40 s, 12 min, 3.5 h.

    Args:
        seconds: the duration.
    """
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
