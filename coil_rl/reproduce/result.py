"""Base classes of reproduced results."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from coil_rl.errors import UserError
from coil_rl.report.runs import Run

Runs = Mapping[str, Sequence[Run]]  # finished runs by experiment, a file name in `conf/experiment`
NO_RUNS: Runs = MappingProxyType({})
# By result: the paper's numbers and claims, and notes on the tables.
PAGES: Any = yaml.safe_load(
    (resources.files("coil_rl.conf") / "result_pages.yaml").read_text("utf-8")
)


class Result(ABC):
    """A table, figure or claim of the paper; the constructor takes its options and checks them."""

    experiments: Sequence[str] = ()  # whose runs it needs; empty if it needs no training

    @abstractmethod
    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result from the finished runs of its experiments, and return its page in Markdown.

        The numbers are written to `stem.csv`, the picture to `stem.png`; `stem` is a path without
        suffix.
        """


class WorldsResult(Result):
    """A result about runs in the main world and in variants of it.

    `experiments` are in the main world, and `worlds` has those in each variant by its name. The
    other runs are compared with those of the label `against`.
    """

    def __init__(
        self,
        experiments: Sequence[str],
        worlds: Mapping[str, Sequence[str]] | None = None,
        against: str = "ppo",
    ) -> None:
        # The main world has no name.
        self.worlds = {"": list(experiments)} | {
            name: list(variant) for name, variant in (worlds or {}).items()
        }
        self.experiments = [
            experiment for experiments in self.worlds.values() for experiment in experiments
        ]
        self.against = against


def runs_by_label(labels: Sequence[str], runs: Runs) -> dict[str, list[Run]]:
    """Return the runs of each label; raises a `UserError` if a label has no run."""
    available = [run for of_experiment in runs.values() for run in of_experiment]
    selected = {label: [run for run in available if run.label == label] for label in labels}
    for label, of_label in selected.items():
        if not of_label:
            existing = ", ".join(dict.fromkeys(run.label for run in available)) or "none"
            raise UserError(
                f"no run of {', '.join(runs)} has the label {label}; available: {existing}"
            )
    return selected
