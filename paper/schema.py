"""Typed root configuration of `coil-reproduce`."""

from dataclasses import dataclass, field
from typing import Annotated, Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from pydantic import Field

from coil_rl import NodeConfig, ProgramConfig

Seeds = Annotated[int, Field(ge=1)]


@dataclass
class RunsBudgetConfig(NodeConfig):
    """A budget of training runs: number of seeds, and overrides of `coil-train`.

    Args:
        seeds: number of runs of each method; their seeds are 0, 1, ...
        seeds_of: another number for the experiments that are named here.
        note: warning on every page that is made with this budget; None for none.
        every: overrides of all runs.
        only: further overrides of the runs of an experiment, by its name.
    """

    seeds: Seeds = MISSING
    seeds_of: dict[str, Seeds] = field(default_factory=dict)
    note: str | None = None
    every: list[str] = field(default_factory=list)
    only: dict[str, list[str]] = field(default_factory=dict)


@dataclass
class ReproduceConfig(ProgramConfig):
    """Configuration of `coil-reproduce`; `conf/reproduce.yaml` explains its keys."""

    table: Any = None
    figure: Any = None
    claim: Any = None
    all: bool = False
    budget: str = MISSING
    budgets: dict[str, RunsBudgetConfig] = MISSING
    aliases: dict[str, str] = field(default_factory=dict)
    other_figures: dict[str, list[int]] = field(default_factory=dict)
    threads: Annotated[int, Field(ge=1, le=1024)] = 1
    train: list[str] = field(default_factory=list)
    known_problems: list[str] = field(default_factory=list)
    not_reproduced: list[str] = field(default_factory=list)
    results: dict[str, Any] = MISSING
    trust: list[str] = field(default_factory=list)
    run_dir: str = MISSING


ConfigStore.instance().store(name="reproduce_schema", node=ReproduceConfig)
