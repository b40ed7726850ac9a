"""`coil-reproduce`: tables, figures and claims of the paper made again, the paper's value beside ours."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig
from tqdm import tqdm

from coil_rl.errors import UserError, did_you_mean
from coil_rl.files import write_text
from coil_rl.programs import app, sweeps
from coil_rl.report.runs import read_runs
from coil_rl.reproduce import Result, Runs, pages
from coil_rl.train.build import build
from coil_rl.train.check import check_values
from coil_rl.train.run_folder import versions

KINDS = ("table", "figure", "claim")
LAUNCHER = ("hydra/launcher=", "hydra.launcher.")
ALL = "RESULTS.md"


def reproduce(config: DictConfig) -> None:
    """Do the runs that are missing, make what was asked for, print it and leave it in the folder with RESULTS.md."""
    torch.set_num_threads(config.threads)
    folder = Path(config.run_dir)
    folder.mkdir(parents=True, exist_ok=True)
    # All are built before the first run begins: a mistake shall cost seconds.
    results = {name: build(config.results[name], f"results.{name}", Result) for name in chosen(config)}
    runs = done(config, list(results.values()))
    commit, note = versions()["commit"], config.budgets[config.budget].note
    for name, result in results.items():
        used = [run for experiment in dict.fromkeys(result.experiments) for run in runs[experiment]]
        origin = pages.origin(command(config, _asked(name), name), commit, used)
        text = pages.page(result.make(folder / name, runs), name, note, origin)
        write_text(folder / f"{name}.md", text)
        print(text)
    kept = {str(name): folder / f"{name}.md" for name in config.results}
    commands = {name: command(config, _asked(name), name) for name in kept}
    texts = {name: path.read_text(encoding="utf-8") if path.exists() else None for name, path in kept.items()}
    everything = command(config, "all=true")
    write_text(
        folder / ALL,
        pages.results(texts, commands, everything, note, config.known_problems, config.cannot),
    )
    print(f"reproduce: {', '.join(results)} made; see {folder / ALL}")


def done(config: DictConfig, results: Sequence[Result]) -> Runs:
    """The runs of all experiments that some results are made from, by experiment, after those missing were done."""
    wanted = list(dict.fromkeys(experiment for result in results for experiment in result.experiments))
    budget = config.budgets[config.budget]
    with tqdm(wanted, unit="experiment", desc="which runs", leave=False, delay=1) as bar:
        found = [
            sweeps.planned(name, [*budget.every, *budget.only.get(name, []), *config.train], range(budget.seeds))
            for name in bar
        ]
    launcher = [word for word in HydraConfig.get().overrides.hydra if word.startswith(LAUNCHER)]
    for sweep in found:
        sweeps.run(sweep, launcher)
    return {sweep.experiment: read_runs(sweep.all_folders) for sweep in found}


def chosen(config: DictConfig) -> list[str]:
    """The names in `results` of what was asked for: table=1 is table_1, figure=world figure_world; others are claims.

    Raises:
        UserError: for one that does not exist, and if nothing was asked for.
    """
    if config.all:
        return [str(name) for name in config.results]
    known = {_asked(name): str(name) for name in config.results}
    known |= {_asked(name): page for name, page in config.also.items()}
    wanted: list[str] = []
    for kind in KINDS:
        given = config[kind]
        for one in given if isinstance(given, ListConfig) else [] if given is None else [given]:
            asked = f"{kind}={one}"
            if asked not in known:
                raise UserError(f"{asked} cannot be made; there are {', '.join(known)}{did_you_mean(asked, known)}")
            wanted.append(known[asked])
    if not wanted:
        raise UserError(f"nothing is asked for; give one of {', '.join(known)}, or several, or all=true")
    return list(dict.fromkeys(wanted))


def command(config: DictConfig, asked: str, name: str = "") -> str:
    """The command that makes a result again, or all without a name, with the choices of this one that matter to it."""
    asking = tuple(f"{key}=" for key in (*KINDS, "all", "budget"))
    given = [word for word in HydraConfig.get().overrides.task if not word.startswith(asking)]
    own = (f"results.{name}.", f"results.{name}=") if name else "results."
    # Hydra adds what a + begins, and takes away what a ~ does.
    keys = {word: word.lstrip("+~") for word in given}
    others = [word for word, key in keys.items() if not key.startswith("results.") or key.startswith(own)]
    return shlex.join(["coil-reproduce", asked, f"budget={config.budget}", *others])


def _asked(name: Any) -> str:
    """How a person asks for a result."""
    kind, _, which = str(name).partition("_")
    return f"{kind}={which}" if kind in KINDS and which else f"claim={name}"


def check(config: DictConfig) -> None:
    """Refuse a configuration of which nothing can be made.

    Raises:
        UserError: in one sentence, what is wrong.
    """
    check_values(config)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise UserError("results are made one after the other; leave out -m, and ask for several as in table=[1,4]")
    if config.threads < 1:
        raise UserError(f"threads={config.threads} must be at least 1")
    if config.budget not in config.budgets:
        known = list(config.budgets)
        raise UserError(f"budget={config.budget} must be one of {', '.join(known)}{did_you_mean(config.budget, known)}")
    if (seeds := config.budgets[config.budget].seeds) < 1:
        raise UserError(f"budgets.{config.budget}.seeds={seeds} must be at least 1")
    chosen(config)


def main() -> None:
    """Entry point."""
    app.run(reproduce, "reproduce", check)


if __name__ == "__main__":
    main()
