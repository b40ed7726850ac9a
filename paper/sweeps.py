"""Training runs of an experiment file: their folders, and the sweep that makes the missing ones.

The folder of a run contains its fingerprint (`hydra.sweep.subdir` of the file), so that a finished
run is found again. The experiment files set `existing=resume`: in a repeated sweep a finished run
returns at once.
"""

import shlex
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from coil_rl import UserError, compose_train


@dataclass(frozen=True)
class Sweep:
    """The runs of an experiment.

    Args:
        experiment: name of its file.
        command: arguments of `coil-train` for the whole sweep.
        all_folders: of the runs.
    """

    experiment: str
    command: tuple[str, ...]
    all_folders: tuple[Path, ...]

    @property
    def missing(self) -> list[Path]:
        """Folders of the runs without an evaluation, which is the last thing that a run writes."""
        return [folder for folder in self.all_folders if not (folder / "evaluation.csv").exists()]


def planned(experiment: str, overrides: Sequence[str], seeds: Iterable[int]) -> Sweep:
    """Return the runs of an experiment file.

    Args:
        experiment: name of the file, of `paper/conf/experiment` or of `conf/experiment`.
        overrides: of `coil-train`, for all runs.
        seeds: of the runs, instead of those of the file.

    Raises:
        UserError: for a file without a sweep, or an override that does not fit one of its runs.
    """
    words = [f"+experiment={experiment}", *overrides]
    seeds, folders = list(seeds), []
    for choice in choices(experiment, words):
        config = _composed(choice)
        for seed in seeds:
            config.seed = seed
            folders.append(Path(config.hydra.sweep.dir, config.hydra.sweep.subdir))
    command = ("-m", *words, f"seed={','.join(map(str, seeds))}")
    return Sweep(experiment, command, tuple(folders))


def choices(experiment: str, words: Sequence[str]) -> Iterator[Sequence[str]]:
    """Yield the words of each run of a sweep, without its seed.

    A word of the command line takes the place of a parameter of the file, as Hydra has it.

    Args:
        experiment: name of the file, for the message.
        words: of the command line of `coil-train`, with this experiment.
    """
    params: dict[str, Any] = dict(_composed(words).hydra.sweeper.params or {})
    if not params:
        raise UserError(f"experiment={experiment} has no hydra.sweeper.params: it is no sweep")
    params.pop("seed", None)
    parsed = OverridesParser.create().parse_overrides(
        [*(f"{key}={value}" for key, value in params.items()), *words]
    )
    (batch,) = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    yield from batch


def run(sweep: Sweep, launcher: Sequence[str] = ()) -> None:
    """Run a sweep unless all of its runs are finished.

    Args:
        launcher: overrides of Hydra's launcher.

    Raises:
        UserError: if the sweep ends before all runs are finished.
    """
    if not sweep.missing:
        return
    command = [*sweep.command, *launcher]
    count = f"{len(sweep.missing)} of {len(sweep.all_folders)} runs are missing"
    print(f"{sweep.experiment}: {count}\n{shlex.join(['coil-train', *command])}", file=sys.stderr)
    code = start(command)
    if code:
        raise UserError(
            f"the sweep of {sweep.experiment} ended with exit code {code}, see above; correct the "
            "cause and give the same command again: finished runs are kept"
        )
    missing = sweep.missing
    if missing:
        raise UserError(
            f"{len(missing)} runs of {sweep.experiment} are still missing, the first is "
            f"{missing[0]}"
        )


def start(arguments: Sequence[str]) -> int:
    """Run `coil-train` in a process of its own, for any launcher; return its exit code."""
    command = [sys.executable, "-m", "coil_rl.programs.train", *arguments]
    try:
        # Progress and errors are on standard error; the tables of the runs are not of interest.
        return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
    except KeyboardInterrupt:
        raise KeyboardInterrupt("give the same command again to continue") from None


def _composed(words: Sequence[str]) -> Any:
    """Return the configuration of a run with Hydra's part; a mistake names the whole command."""
    try:
        return compose_train(words, with_hydra=True)
    except UserError as error:
        raise UserError(f"{shlex.join(['coil-train', *words])}: {error}") from error
