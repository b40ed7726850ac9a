"""`coil-reproduce`: reproduce tables, figures and claims of the paper."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, ListConfig

import coil_paper.schema  # noqa: F401  registers the root configuration with Hydra
from coil_rl import UserError, did_you_mean, run_program

if TYPE_CHECKING:
    from coil_paper.reproduce.result import Result, Runs

KINDS = ("table", "figure", "claim")
LAUNCHER = ("hydra/launcher=", "hydra.launcher.")
INDEX = "RESULTS.md"


def reproduce(config: DictConfig) -> None:
    """Train the missing runs, and make the requested results.

    Their pages are printed, and written with RESULTS.md.
    """
    from coil_paper.reproduce import pages
    from coil_paper.reproduce.result import Result, check_pools
    from coil_rl import build, versions, write_text

    folder = Path(config.run_dir)
    folder.mkdir(parents=True, exist_ok=True)
    # Build all results before the first run, so that mistakes cost seconds.
    results: dict[str, Result] = {}
    for name in requested(config):
        results[name] = build(config.results[name], f"results.{name}", Result)
    runs = trained_runs(config, list(results.values()))
    for result in results.values():
        check_pools(result, runs)
    note = config.budgets[config.budget].note
    for name, result in results.items():
        used = list(chain.from_iterable(runs[each] for each in dict.fromkeys(result.experiments)))
        origin = pages.origin(command(config, _key(name), name), versions()["commit"], used)
        text = pages.page(result.make(folder / name, runs), name, note, origin)
        write_text(folder / f"{name}.md", text)
        print(text)
    write_text(folder / INDEX, _index(config, folder))
    print(f"reproduce: {', '.join(results)} made; see {folder / INDEX}")


def _index(config: DictConfig, folder: Path) -> str:
    """Return RESULTS.md, which has the pages of all results that were made, also earlier."""
    from coil_paper.reproduce import pages

    names = list(map(str, config.results))
    files = {name: folder / f"{name}.md" for name in names}
    return pages.all_results(
        {name: file.read_text("utf-8") if file.exists() else None for name, file in files.items()},
        {name: command(config, _key(name), name) for name in names},
        command(config, "all=true"),
        config.budgets[config.budget].note,
        config.known_problems,
        config.not_reproduced,
    )


def trained_runs(config: DictConfig, results: Sequence[Result]) -> Runs:
    """Return the runs of all experiments of some results, after training the missing ones."""
    from coil_paper import sweeps
    from coil_rl.report import read_runs

    budget = config.budgets[config.budget]
    planned = []
    for name in dict.fromkeys(chain.from_iterable(result.experiments for result in results)):
        overrides = [*budget.every, *budget.only.get(name, []), *config.train]
        seeds = range(budget.seeds_of.get(name, budget.seeds))
        planned.append(sweeps.planned(name, overrides, seeds))
    launcher = [word for word in HydraConfig.get().overrides.hydra if word.startswith(LAUNCHER)]
    for sweep in planned:
        sweeps.run(sweep, launcher)
    return {sweep.experiment: read_runs(sweep.all_folders) for sweep in planned}


def requested(config: DictConfig) -> list[str]:
    """Return the names in `results` of the requested results, at least one.

    Raises:
        UserError: if nothing is requested, or something unknown.
    """
    if config.all:
        return [str(name) for name in config.results]
    available = {_key(str(name)): str(name) for name in config.results}
    available |= {_key(str(alias)): name for alias, name in config.aliases.items()}
    names: list[str] = []
    for kind in KINDS:
        values = config[kind] if isinstance(config[kind], ListConfig) else [config[kind]]
        for key in (f"{kind}={value}" for value in values if value is not None):
            _check_key(config, key, available)
            names.append(available[key])
    if not names:
        raise UserError(
            f"nothing is requested; give one of {', '.join(available)}, or several, or all=true"
        )
    return list(dict.fromkeys(names))


def _check_key(config: DictConfig, key: str, available: Mapping[str, str]) -> None:
    """Raise a `UserError` if the key of a request is unknown."""
    for what, numbers in config.other_figures.items():
        if key in [f"figure={number}" for number in numbers]:
            raise UserError(
                f"{key} is {what}, which is not reproduced; there are {', '.join(available)}"
            )
    if key not in available:
        raise UserError(
            f"{key} does not exist; there are {', '.join(available)}{did_you_mean(key, available)}"
        )


def command(config: DictConfig, key: str, name: str = "") -> str:
    """Return the command that makes a result, with the given options that affect it.

    Args:
        key: what is requested, such as "table=1", or "all=true".
        name: of the result; empty for all results.
    """
    requests = tuple(f"{request}=" for request in (*KINDS, "all", "budget"))
    own = (f"results.{name}.", f"results.{name}=") if name else "results."
    options = []
    for word in HydraConfig.get().overrides.task:
        option = word.lstrip("+~")  # Hydra's signs for adding and deleting a key
        is_of_other = option.startswith("results.") and not option.startswith(own)
        if not word.startswith(requests) and not is_of_other:
            options.append(word)
    return shlex.join(["coil-reproduce", key, f"budget={config.budget}", *options])


def check(config: DictConfig) -> None:
    """Raise a `UserError` for the first mistake in the configuration."""
    if config.budget not in config.budgets:
        names = list(config.budgets)
        raise UserError(
            f"budget={config.budget} must be one of {', '.join(names)}"
            f"{did_you_mean(config.budget, names)}"
        )
    requested(config)


def _key(name: str) -> str:
    """Return the key of a result on the command line.

    It is table=1 for the name table_1, and claim=NAME for names of no other kind.
    """
    kind, _, rest = name.partition("_")
    return f"{kind}={rest}" if kind in KINDS and rest else f"claim={name}"


NO_SWEEP = (
    "results are made one after the other; leave out -m, and request several as in table=[1,4]"
)
main = partial(
    run_program, reproduce, "reproduce", check, "pkg://coil_paper.conf", no_sweep=NO_SWEEP
)

if __name__ == "__main__":
    main()
