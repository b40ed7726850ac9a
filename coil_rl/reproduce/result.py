"""What a result of the paper is to the program that makes it again."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from coil_rl.errors import UserError
from coil_rl.report.runs import Run

Runs = Mapping[str, Sequence[Run]]  # of each file of `conf/experiment`, finished
NO_RUNS: Runs = MappingProxyType({})


class Result(ABC):
    """A table, a figure or a claim of the paper; its constructor takes the choices and refuses wrong ones.

    Attributes:
        experiments: the files of `conf/experiment` of whose runs it is made; none if it needs no training.
    """

    experiments: Sequence[str] = ()

    @abstractmethod
    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it, with the paper's values beside ours.

        Args:
            stem: where to, without ending: all numbers go to `stem.csv`, the picture to `stem.png`.
            runs: of its experiments.

        Returns:
            The page, Markdown: the table, and what there is to say about it.
        """


def called(labels: Sequence[str], runs: Runs) -> dict[str, list[Run]]:
    """The runs of each of some labels.

    Args:
        labels: that are wanted.
        runs: by experiment.

    Raises:
        UserError: if a label has none.
    """
    there = [run for of_experiment in runs.values() for run in of_experiment]
    found = {label: [run for run in there if run.label == label] for label in labels}
    for label, of_label in found.items():
        if not of_label:
            known = ", ".join(dict.fromkeys(run.label for run in there))
            raise UserError(f"no run of {', '.join(runs)} is called {label}; there are {known or 'none'}")
    return found
