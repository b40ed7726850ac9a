"""Base classes of the paper's reproduced results, and what all of them read.

A result is built from its YAML file in `paper/conf/reproduce` and makes its files and its page, see
`Result`.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from importlib import resources
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

from coil_rl import UserError
from coil_rl.report import Run, differing, listed

# Finished runs by experiment, the name of a file in `paper/conf/experiment`.
Runs = Mapping[str, Sequence[Run]]
NO_RUNS: Runs = MappingProxyType({})
# By result: the paper's numbers and claims, and notes on the tables.
PAGES: Any = yaml.safe_load(
    (resources.files("coil_paper.conf") / "result_pages.yaml").read_text("utf-8")
)


class Result(ABC):
    """A table, figure or claim of the paper; the constructor takes its options and checks them."""

    experiments: Sequence[str] = ()  # whose runs it needs; empty if it needs no training

    @property
    def pools(self) -> list[Sequence[str]]:
        """Groups of experiments; runs of one label in a group are means of one another."""
        return [self.experiments]

    @abstractmethod
    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Write the numbers and the picture of the result, and return its page in Markdown.

        Args:
            stem: the path of the result's files without suffix: the numbers are written to
                `stem.csv`, the picture to `stem.png`.
            runs: the finished runs of its `experiments`.
        """


class WorldsResult(Result):
    """A result about runs in the main world and in variants of it.

    Args:
        experiments: names of the experiments in the main world, files of `paper/conf/experiment`.
        worlds: the experiments in each variant of the main world by its name; none by default.
        against: label of the runs with which the others are compared.
    """

    def __init__(
        self,
        experiments: Sequence[str],
        worlds: Mapping[str, Sequence[str]] | None = None,
        against: str = "ppo",
    ) -> None:
        self.worlds = {"": list(experiments)}  # the main world has no name
        for name, variant in (worlds or {}).items():
            self.worlds[name] = list(variant)
        self.experiments = list(chain.from_iterable(self.worlds.values()))
        self.against = against

    @property
    def pools(self) -> list[Sequence[str]]:
        """The experiments of each world."""
        return list(self.worlds.values())


def check_pools(result: Result, runs: Runs) -> None:
    """Check that runs of one label, of which a result shows means, differ by their seed only.

    Args:
        runs: the finished runs by experiment.

    Raises:
        UserError: if the configurations of such runs differ; it names the keys.
    """
    for experiments in result.pools:
        pooled = list(chain.from_iterable(runs[each] for each in dict.fromkeys(experiments)))
        for label in dict.fromkeys(run.label for run in pooled):
            keys = differing([run for run in pooled if run.label == label])
            if keys:
                raise UserError(
                    f"experiment={', '.join(experiments)}: the runs of {label} differ in "
                    f"{listed(keys)}; give them labels of their own, label=NAME, or move the "
                    "folders of the other runs away"
                )


def runs_by_label(labels: Sequence[str], runs: Runs) -> dict[str, list[Run]]:
    """Return the runs of each label.

    Args:
        runs: the available runs by experiment.

    Raises:
        UserError: if a label has no run.
    """
    available = list(chain.from_iterable(runs.values()))
    selected = {label: [run for run in available if run.label == label] for label in labels}
    for label, of_label in selected.items():
        if not of_label:
            existing = ", ".join(dict.fromkeys(run.label for run in available)) or "none"
            raise UserError(
                f"no run of {', '.join(runs)} has the label {label}; available: {existing}"
            )
    return selected
