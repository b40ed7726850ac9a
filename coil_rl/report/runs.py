"""Configuration, evaluation and learning curve of finished runs, read from their folders.

pandas takes half a second to import, so only what reads an evaluation does. A training does not.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from coil_rl import record
from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import FAILED_JOBS, LARGEST_NUMBERS, read_text
from coil_rl.measures import MEAN_CASE, Measure, measures_of
from coil_rl.plain_yaml import read_yaml

if TYPE_CHECKING:
    import pandas as pd

GUIDE = "guide"  # in the column `driver` of evaluation.csv
FALLBACK = f" or {GUIDE}"  # after the label, there: the policy with a guide to fall back to
EVALUATION = "evaluation"  # set of cases for reports
SELECTION = "selection"  # set of cases for the choice of the best policy
RETURN, CHOICE = f"{EVALUATION}/return", f"{SELECTION}/return"  # columns of metrics.csv
TERM = "reward_"  # prefix of the measures without a heading that are terms of the reward
RESTORE = "restore the file, or remove the run from the folder"


def _no_rows() -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame()


@dataclass(frozen=True, eq=False)
class Run:
    """One training run.

    Attributes:
        folder: of the run.
        label: shared by the seeds of one method.
        seed: of the run.
        needs_guide: whether the agent needs the guide during evaluation; None without an agent.
        evaluation: one row per policy and case, empty until the run is finished: `driver` ("guide",
            "guide NAME" for one of several, or the label), `advice` (its modification, such as
            "zeroed"; empty for none), `actions` ("deterministic" or "sampled"), `case`, `reward`,
            and the measures.
        measures: definitions of the measures by name.
        curve: rows of metrics.csv; empty without training.
        guide_returns: mean return of each guide in the evaluation, if known.
        seconds: duration of the training; None if unknown, as for an interrupted run.
        handed_over: which policy a test at its end chose, such as "last"; `UNTESTED` if no frames
            were left for it; empty without a test.
        settings: its configuration.
        command: the words that made it; empty if they are not known.
    """

    folder: Path
    label: str
    seed: int
    needs_guide: bool | None
    evaluation: pd.DataFrame = field(default_factory=_no_rows, repr=False)
    measures: Mapping[str, Measure] = field(default_factory=dict, repr=False)
    curve: Sequence[dict[str, float]] = field(default=(), repr=False)
    guide_returns: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None
    handed_over: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict, repr=False)
    command: Sequence[str] = field(default=(), repr=False)

    @property
    def finished(self) -> bool:
        """Whether the run has been evaluated."""
        return not self.evaluation.empty

    def episodes_of(self, driver: str) -> pd.DataFrame:
        """Return the evaluation of a policy with deterministic actions and the advice as it is."""
        table = self.evaluation
        plain = (table["advice"] == "") & (table["actions"] == "deterministic")
        return table[plain & (table["driver"] == driver)]


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """Return all runs in some folders, at any depth, sorted by folder.

    Args:
        folders: the folders; a run that is in several of them is read once.

    Raises:
        UserError: if a folder is missing or holds no run, or a file of a run is damaged.
    """
    runs: dict[Path, Run] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UserError(
                f"folder={folder} does not exist; give a folder with runs of coil-train"
            )
        configs = [path for path in sorted(folder.rglob("config.yaml")) if _is_run(path, folder)]
        if not configs:
            raise UserError(
                f"folder={folder} holds no run of coil-train: nothing in it has a config.yaml"
            )
        # Overlapping folders may hold the same run.
        for path in configs:
            if path.resolve() not in runs:
                runs[path.resolve()] = _read_run(path.parent)
    return list(runs.values())


def by_label(runs: Iterable[Run]) -> dict[str, list[Run]]:
    """Return runs by their label, in their order."""
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(run.label, []).append(run)
    return found


def begun_with(settings: Mapping[str, Any]) -> str | None:
    """Return which earlier policy or data a run began with; None if it began with neither."""
    if init := settings.get("init"):
        return f"the policy of {init}"
    learner = settings.get("learner")
    dataset = learner.get("dataset") if isinstance(learner, Mapping) else None
    return f"the data of {dataset}" if dataset else None


def failed_jobs(folders: Iterable[Path]) -> int:
    """Return the number of jobs that sweeps in some folders have refused, or that failed."""
    files = {path.resolve() for folder in folders for path in folder.rglob(FAILED_JOBS)}
    count = 0
    for path in sorted(files):
        with file_of_a_run(path, "remove it"):
            # A job that failed in several programs of a sweep has a line of each.
            count += len(set(read_text(path, LARGEST_NUMBERS).splitlines()))
    return count


def _is_run(config: Path, folder: Path) -> bool:
    """Return whether a config.yaml belongs to a run, and not to something inside of a run.

    Inside of a run are `.hydra`, and the runs of its proxies.
    """
    parts = config.relative_to(folder).parts
    if any(part.startswith(".") for part in parts):
        return False
    outer = [folder.joinpath(*parts[:depth], config.name) for depth in range(len(parts) - 1)]
    return not any(path.exists() for path in outer)


def _read_run(folder: Path) -> Run:
    """Return the run in a folder; without an evaluation only what its configuration says."""
    run = _read_config(folder / "config.yaml")
    rows = record.EVALUATION.read(folder)
    if rows is None:
        return run
    with file_of_a_run(folder / record.EVALUATION.name, RESTORE):
        shown = [name for name, measure in run.measures.items() if measure.heading(name)]
        evaluation = _cases_of(rows, shown)
    delivery = record.DELIVERY.read(folder)
    return replace(
        run,
        evaluation=evaluation,
        curve=record.METRICS.read(folder) or [],
        guide_returns=record.GUIDE_RETURNS.read(folder) or {},
        seconds=(record.SECONDS.read(folder) or {}).get("seconds"),
        handed_over=delivery.policy if delivery is not None else "",
        command=record.COMMAND.read(folder) or (),
    )


def _read_config(path: Path) -> Run:
    """Return what the configuration of a run says."""
    try:
        config = read_yaml(path)
        if not isinstance(config, dict):
            raise ValueError("a list")
        return Run(
            path.parent,
            str(config["label"]),
            int(config["seed"]),
            config["method"]["needs_guide"],
            measures=measures_of((config.get("evaluation") or {}).get("measures") or {}),
            settings=config,
        )
    except (yaml.YAMLError, AttributeError, ValueError, TypeError, KeyError) as error:
        problem = " ".join(str(error).split())
        if isinstance(error, KeyError):
            problem = f"Missing key {error.args[0]}"
        raise UserError(
            f"{path} has no valid label, seed and method.needs_guide ({problem}); "
            "restore the file that coil-train wrote, or remove the run from the folder"
        ) from error


def _cases_of(rows: Sequence[record.Row], shown: Iterable[str]) -> pd.DataFrame:
    """Return the rows of an evaluation, without those of means.

    Args:
        shown: measures that reports show, of which there must be a column.
    """
    import pandas as pd

    for name in shown:
        if name not in rows[0]:
            raise ValueError(f"no column {name}")
    frame = pd.DataFrame(rows)
    frame = frame[frame["case"] != MEAN_CASE]
    if frame.empty:
        raise ValueError("no rows")
    return frame
