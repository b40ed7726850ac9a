"""`coil-reproduce`: reproduce tables, figures and claims of the paper."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig

import coil_paper.schema  # noqa: F401  registers the root configuration with Hydra
from coil_rl import UserError, did_you_mean, run_program

if TYPE_CHECKING:
    from coil_paper.reproduce.result import Result, Runs

KINDS = ("table", "figure", "claim")
LAUNCHER = ("hydra/launcher=", "hydra.launcher.")
INDEX = "RESULTS.md"


def reproduce(config: DictConfig) -> None:
    """Train the missing runs, and make, print and write the requested results and RESULTS.md."""
    import torch

    from coil_paper.reproduce import pages
    from coil_paper.reproduce.result import Result
    from coil_rl import build, versions, write_text

    torch.set_num_threads(config.threads)
    folder = Path(config.run_dir)
    folder.mkdir(parents=True, exist_ok=True)
    # Build all results before the first run, so that mistakes cost seconds.
    results = {
        name: build(config.results[name], f"results.{name}", Result) for name in requested(config)
    }
    runs = trained_runs(config, list(results.values()))
    note = config.budgets[config.budget].note
    for name, result in results.items():
        used = [run for experiment in dict.fromkeys(result.experiments) for run in runs[experiment]]
        origin = pages.origin(command(config, _key(name), name), versions()["commit"], used)
        text = pages.page(result.make(folder / name, runs), name, note, origin)
        write_text(folder / f"{name}.md", text)
        print(text)
    files = {str(name): folder / f"{name}.md" for name in config.results}
    texts = {
        name: path.read_text(encoding="utf-8") if path.exists() else None
        for name, path in files.items()
    }
    commands = {name: command(config, _key(name), name) for name in files}
    everything, problems = command(config, "all=true"), config.known_problems
    index = pages.all_results(texts, commands, everything, note, problems, config.not_reproduced)
    write_text(folder / INDEX, index)
    print(f"reproduce: {', '.join(results)} made; see {folder / INDEX}")


def trained_runs(config: DictConfig, results: Sequence[Result]) -> Runs:
    """Return the runs of all experiments of some results, after training the missing ones."""
    from coil_paper import sweeps
    from coil_rl.report import read_runs

    budget = config.budgets[config.budget]
    planned = [
        sweeps.planned(
            name,
            [*budget.every, *budget.only.get(name, []), *config.train],
            range(budget.seeds_of.get(name, budget.seeds)),
        )
        for name in dict.fromkeys(
            experiment for result in results for experiment in result.experiments
        )
    ]
    launcher = [word for word in HydraConfig.get().overrides.hydra if word.startswith(LAUNCHER)]
    for sweep in planned:
        sweeps.run(sweep, launcher)
    return {sweep.experiment: read_runs(sweep.all_folders) for sweep in planned}


def requested(config: DictConfig) -> list[str]:
    """Return the names in `results` of the requested results, at least one.

    Raises:
        UserError: if nothing is requested, or something that does not exist.
    """
    if config.all:
        return [str(name) for name in config.results]
    available = {_key(str(name)): str(name) for name in config.results}
    available |= {_key(str(alias)): name for alias, name in config.aliases.items()}
    names: list[str] = []
    for kind in KINDS:
        values = config[kind] if isinstance(config[kind], ListConfig) else [config[kind]]
        for key in (f"{kind}={value}" for value in values if value is not None):
            for what, numbers in config.other_figures.items():
                if key in [f"figure={number}" for number in numbers]:
                    raise UserError(
                        f"{key} is {what}, which is not reproduced; "
                        f"there are {', '.join(available)}"
                    )
            if key not in available:
                raise UserError(
                    f"{key} does not exist; there are {', '.join(available)}"
                    f"{did_you_mean(key, available)}"
                )
            names.append(available[key])
    if not names:
        raise UserError(
            f"nothing is requested; give one of {', '.join(available)}, or several, or all=true"
        )
    return list(dict.fromkeys(names))


def command(config: DictConfig, key: str, name: str = "") -> str:
    """Return the command that makes a result, or all, with the given options that affect it."""
    requests = tuple(f"{request}=" for request in (*KINDS, "all", "budget"))
    own = (f"results.{name}.", f"results.{name}=") if name else "results."
    options = []
    for word in HydraConfig.get().overrides.task:
        option = word.lstrip("+~")  # Hydra's signs for adding and deleting a key
        if not word.startswith(requests) and (
            not option.startswith("results.") or option.startswith(own)
        ):
            options.append(word)
    return shlex.join(["coil-reproduce", key, f"budget={config.budget}", *options])


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    from coil_rl import check_values

    check_values(config)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        raise UserError(
            "results are made one after the other; leave out -m, "
            "and request several as in table=[1,4]"
        )
    if config.budget not in config.budgets:
        names = list(config.budgets)
        raise UserError(
            f"budget={config.budget} must be one of {', '.join(names)}"
            f"{did_you_mean(config.budget, names)}"
        )
    requested(config)


def _key(name: str) -> str:
    """Return the key of a result on the command line: table=1 for table_1, otherwise claim=NAME."""
    kind, _, rest = name.partition("_")
    return f"{kind}={rest}" if kind in KINDS and rest else f"claim={name}"


main = partial(run_program, reproduce, "reproduce", check, "pkg://coil_paper.conf")

if __name__ == "__main__":
    main()
