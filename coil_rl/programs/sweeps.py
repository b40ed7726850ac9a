"""The runs of an experiment file: which of them are done, and `coil-train -m` for those that are not.

A run is known by the folder that its configuration gives it, so `hydra.sweep.subdir` of the file has a fingerprint.
What is missing is run as a person would, in a process of its own, so that every launcher of Hydra serves.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from coil_rl.errors import UserError
from coil_rl.sentence import sentence
from coil_rl.train.evaluate_run import is_evaluated

Choice = tuple[str, ...]  # what is swept besides the seed, as on a command line


@dataclass(frozen=True)
class Sweep:
    """The runs of an experiment.

    Attributes:
        experiment: name of its file.
        given: what all its runs are given besides, as on a command line.
        folders: of the runs, by choice and seed.
    """

    experiment: str
    given: tuple[str, ...]
    folders: Mapping[Choice, Mapping[int, Path]]

    @property
    def all_folders(self) -> list[Path]:
        """Of all runs."""
        return [folder for of_choice in self.folders.values() for folder in of_choice.values()]

    @property
    def missing(self) -> list[Path]:
        """Those that have not been judged."""
        return [folder for folder in self.all_folders if not is_evaluated(folder)]

    def commands(self) -> list[list[str]]:
        """What `coil-train` is to be given so that what is missing is done: as few sweeps as that takes."""
        of_seeds: dict[tuple[int, ...], list[Choice]] = {}
        for choice, by_seed in self.folders.items():
            seeds = tuple(seed for seed, folder in by_seed.items() if not is_evaluated(folder))
            if seeds:
                of_seeds.setdefault(seeds, []).append(choice)
        sweeps = [(seeds, part) for seeds, choices in of_seeds.items() for part in _products(choices)]
        return [
            ["-m", f"+experiment={self.experiment}", *self.given, *part, f"seed={','.join(map(str, seeds))}"]
            for seeds, part in sweeps
        ]


def planned(experiment: str, given: Sequence[str], seeds: Sequence[int]) -> Sweep:
    """The runs of an experiment, with these seeds in place of its own. Hydra must have been initialised.

    Raises:
        UserError: if the file sweeps over nothing, or a choice and what is given do not fit together.
    """
    # Hydra, too, begins with what is given and no choice, and then it is late to find that they do not fit together.
    params: dict[str, Any] = dict(_composed(experiment, *given).hydra.sweeper.params or {})
    if not params:
        raise UserError(f"experiment={experiment} has no hydra.sweeper.params: it is no sweep")
    parser = OverridesParser.create()
    swept = [
        [f"{key}={value}" for value in override.sweep_string_iterator()] if override.is_sweep_override()
        else [f"{key}={value}"]
        for key, value in params.items() if key != "seed"
        for override in [parser.parse_override(f"{key}={value}")]
    ]  # fmt: skip
    folders: dict[Choice, dict[int, Path]] = {}
    for choice in product(*swept):
        config = _composed(experiment, *given, *choice)
        folders[choice] = {}
        for seed in seeds:
            config.seed = seed
            folders[choice][seed] = Path(config.hydra.sweep.dir, config.hydra.sweep.subdir)
    return Sweep(experiment, tuple(given), folders)


def run(sweep: Sweep, launcher: Sequence[str] = ()) -> None:
    """Do the runs that are missing.

    Args:
        sweep: whose runs.
        launcher: what chooses and sets the launcher, as on a command line.

    Raises:
        UserError: if a sweep ends before its runs are done.
    """
    commands = sweep.commands()
    for words in commands:
        command = [*words, *launcher]
        count = f"{len(sweep.missing)} of {len(sweep.all_folders)} runs are missing"
        print(f"{sweep.experiment}: {count}\n{shlex.join(['coil-train', *command])}", file=sys.stderr)
        if code := start(command):
            raise UserError(
                f"a sweep of {sweep.experiment} ended with code {code}, and says above why; "
                "mend that, and give the same command again: what is finished stays"
            )
    if commands and (left := sweep.missing):
        raise UserError(f"{len(left)} runs of {sweep.experiment} are still missing, the first of them {left[0]}")


def start(words: Sequence[str]) -> int:
    """Let `coil-train` do what these words say, in a process of its own; returns its exit code."""
    # Its tables are not what was asked for; bars and mistakes go to standard error.
    command = [sys.executable, "-m", "coil_rl.programs.train", *words]
    try:
        return subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode
    except KeyboardInterrupt:
        raise KeyboardInterrupt("the same command goes on") from None


def _composed(experiment: str, *overrides: str) -> Any:
    try:
        return compose("train", [f"+experiment={experiment}", *overrides], return_hydra_config=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(f"coil-train +experiment={experiment} {' '.join(overrides)}: {sentence(error)}") from error


def _products(choices: Sequence[Choice]) -> list[list[str]]:
    """As sweeps: one if the choices are a product, else one each."""
    values = [list(dict.fromkeys(column)) for column in zip(*choices, strict=True)]
    if len(list(product(*values))) != len(choices):
        return [list(choice) for choice in choices]
    split = [[word.partition("=") for word in column] for column in values]
    return [[f"{words[0][0]}={','.join(value for *_, value in words)}" for words in split]]
