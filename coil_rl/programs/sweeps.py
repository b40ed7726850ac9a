"""Training runs of an experiment file: their folders, and the sweep that does the missing ones.

The folder of a run contains its fingerprint (`hydra.sweep.subdir` of the file), so that a finished
run is found again. The experiment files set `existing=resume`: in a repeated sweep a finished run
returns at once.
"""

import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from coil_rl.config.sentences import sentence
from coil_rl.errors import UserError
from coil_rl.run.folder import is_evaluated


@dataclass(frozen=True)
class Sweep:
    """The runs of an experiment.

    Attributes:
        experiment: name of its file.
        command: arguments of `coil-train` for the whole sweep.
        all_folders: of the runs.
    """

    experiment: str
    command: tuple[str, ...]
    all_folders: tuple[Path, ...]

    @property
    def missing(self) -> list[Path]:
        """Folders of the runs without an evaluation."""
        return [folder for folder in self.all_folders if not is_evaluated(folder)]


def planned(experiment: str, overrides: Sequence[str], seeds: Iterable[int]) -> Sweep:
    """Return the runs of an experiment file. Hydra must be initialised.

    Args:
        experiment: name of the file.
        overrides: of every run.
        seeds: of the runs, in place of those of the file.

    Raises:
        UserError: if the file has no sweep, or an override does not fit one of its runs.
    """
    # Hydra also composes the overrides alone first.
    params: dict[str, Any] = dict(_composed(experiment, *overrides).hydra.sweeper.params or {})
    if not params:
        raise UserError(f"experiment={experiment} has no hydra.sweeper.params: it is no sweep")
    params.pop("seed", None)
    parsed = OverridesParser.create().parse_overrides(
        [f"{key}={value}" for key, value in params.items()]
    )
    (choices,) = BasicSweeper.split_arguments(parsed, max_batch_size=None)
    seeds, folders = list(seeds), []
    for choice in choices:
        config = _composed(experiment, *overrides, *choice)
        for seed in seeds:
            config.seed = seed
            folders.append(Path(config.hydra.sweep.dir, config.hydra.sweep.subdir))
    command = ("-m", f"+experiment={experiment}", *overrides, f"seed={','.join(map(str, seeds))}")
    return Sweep(experiment, command, tuple(folders))


def run(sweep: Sweep, launcher: Sequence[str] = ()) -> None:
    """Do the missing runs of a sweep.

    Args:
        sweep: the runs.
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
            f"the sweep of {sweep.experiment} ended with exit code {code}, see above; "
            "correct the cause and give the same command again: finished runs are kept"
        )
    missing = sweep.missing
    if missing:
        raise UserError(
            f"{len(missing)} runs of {sweep.experiment} are still missing, "
            f"the first is {missing[0]}"
        )


def start(arguments: Sequence[str]) -> int:
    """Run `coil-train` in a process of its own, so that any launcher works.

    Args:
        arguments: of the command line.

    Returns:
        The exit code.
    """
    command = [sys.executable, "-m", "coil_rl.programs.train", *arguments]
    try:
        # Progress and errors are on standard error; the tables of the runs are not of interest
        # here.
        return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
    except KeyboardInterrupt:
        raise KeyboardInterrupt("give the same command again to continue") from None


def _composed(experiment: str, *overrides: str) -> Any:
    """Return the configuration of a run of an experiment."""
    try:
        return compose("train", [f"+experiment={experiment}", *overrides], return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(
            f"coil-train +experiment={experiment} {' '.join(overrides)}: {sentence(error)}"
        ) from error
