"""Configuration, evaluation and learning curve of finished runs, read from their folders.

pandas takes half a second to import, so only what reads an evaluation does. A training does not.
"""

from __future__ import annotations

import csv
import io
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import yaml

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.files import FAILED_JOBS, LARGEST_NUMBERS, LARGEST_TABLE, read_file, read_text
from coil_rl.measures import MEAN_CASE, Measure, measures_of
from coil_rl.plain_yaml import read_yaml

if TYPE_CHECKING:
    import pandas as pd

GUIDE = "guide"  # in the column `driver` of evaluation.csv
FALLBACK = f" or {GUIDE}"  # after the label, there: the policy with a guide to fall back to
DRIVER = ("driver", "advice", "actions", "case")
EVALUATION = "evaluation"  # set of cases for reports
SELECTION = "selection"  # set of cases for the choice of the best policy
RETURN, CHOICE = f"{EVALUATION}/return", f"{SELECTION}/return"  # columns of metrics.csv
PER_STEP = "per_step_"  # prefix of the measures of tasks
TERM = "reward_"  # prefix of the measures of the terms of the reward
DELIVERY = "delivery.json"  # of a run: which policy it hands over, and why
UNTESTED = "last_untested"  # in that file: the last policy, as no frames were left for a test
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

    @property
    def finished(self) -> bool:
        """Whether the run has been evaluated."""
        return not self.evaluation.empty


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
        run_folders = [
            path.parent for path in sorted(folder.rglob("config.yaml")) if _is_run(path, folder)
        ]
        if not run_folders:
            raise UserError(
                f"folder={folder} holds no run of coil-train: nothing in it has a config.yaml"
            )
        # Overlapping folders may hold the same run.
        for path in run_folders:
            if path.resolve() not in runs:
                runs[path.resolve()] = _read_run(path)
    return list(runs.values())


def begun_with(settings: Mapping[str, Any]) -> str | None:
    """Return which earlier policy or data a run began with; None if it began with neither.

    Args:
        settings: the configuration of the run.
    """
    if init := settings.get("init"):
        return f"the policy of {init}"
    learner = settings.get("learner")
    dataset = learner.get("dataset") if isinstance(learner, Mapping) else None
    return f"the data of {dataset}" if dataset else None


def failed_jobs(folders: Iterable[Path]) -> int:
    """Return the number of jobs that sweeps in some folders have refused, or that failed.

    Args:
        folders: the folders, and all in them.
    """
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
    run, measures = _read_config(folder / "config.yaml")
    path = folder / "evaluation.csv"
    if not path.exists():
        return run
    again = shlex.join(["coil-train", f"resume={folder}"])
    with file_of_a_run(path, f"remove the file and write it again by {again}"):
        shown = [name for name, measure in measures.items() if measure.title]
        evaluation = _read_evaluation(path, shown)
    path = folder / "metrics.csv"
    with file_of_a_run(path, RESTORE):
        curve = read_curve(path) if path.exists() else []
    return replace(
        run,
        evaluation=evaluation,
        measures=measures,
        curve=curve,
        guide_returns=_read_numbers(folder / "guide_return.json"),
        seconds=_read_numbers(folder / "training_time.json").get("seconds"),
        handed_over=_handed_over(folder / DELIVERY),
    )


def _handed_over(path: Path) -> str:
    """Return which policy a run handed over; empty without the file."""
    with file_of_a_run(path, RESTORE):
        if not path.exists():
            return ""
        return str(json.loads(read_file(path, LARGEST_NUMBERS))["policy"])


def _read_config(path: Path) -> tuple[Run, dict[str, Measure]]:
    """Return what the configuration of a run says: the run, and the definitions of its measures."""
    try:
        config = read_yaml(path)
        if not isinstance(config, dict):
            raise ValueError("a list")
        label, seed = str(config["label"]), int(config["seed"])
        run = Run(path.parent, label, seed, config["method"]["needs_guide"], settings=config)
        measures = measures_of((config.get("evaluation") or {}).get("measures") or {})
    except (yaml.YAMLError, AttributeError, ValueError, TypeError, KeyError) as error:
        problem = " ".join(str(error).split())
        if isinstance(error, KeyError):
            problem = f"Missing key {error.args[0]}"
        raise UserError(
            f"{path} has no valid label, seed and method.needs_guide ({problem}); "
            "restore the file that coil-train wrote, or remove the run from the folder"
        ) from error
    return run, measures


def _read_numbers(path: Path) -> dict[str, float]:
    """Return the numbers in a JSON file by name; none without the file."""
    with file_of_a_run(path, RESTORE):
        saved = json.loads(read_file(path, LARGEST_NUMBERS)) if path.exists() else {}
        return {key: float(value) for key, value in saved.items()}


def _read_evaluation(path: Path, shown: Iterable[str]) -> pd.DataFrame:
    """Return the rows of an evaluation.csv, without those of means.

    Args:
        path: of the file.
        shown: measures that reports show, of which there must be a column.
    """
    import pandas as pd

    rows = read_table(path)
    if not rows:
        raise ValueError("no rows")
    frame = pd.DataFrame(rows)
    for name in shown:
        if name not in frame and set(DRIVER) <= set(frame):
            raise ValueError(f"no column {name}")
    numbers = ["reward", *(column for column in frame if column not in (*DRIVER, "reward"))]
    frame = frame[[*DRIVER, *numbers]].astype(dict.fromkeys(numbers, float))
    frame = frame[frame["case"] != MEAN_CASE]
    if frame.empty:
        raise ValueError("no rows")
    if frame.duplicated(list(DRIVER)).any():
        raise ValueError("two rows of one driver in the same case")
    return frame


def read_curve(file: Path | BinaryIO) -> list[dict[str, float]]:
    """Return the rows of a `metrics.csv`.

    Args:
        file: its path, or the opened file.

    Raises:
        ValueError: if a cell is no number, or `frames` is missing.
    """
    rows = [{name: float(cell) for name, cell in row.items()} for row in read_table(file)]
    if not all(np.isfinite(row.get("frames", np.nan)) for row in rows):
        raise ValueError("not every row has its number of frames")
    return rows


def read_table(file: Path | BinaryIO) -> list[dict[str, str]]:
    """Return the rows of a CSV file by the names of its columns, all cells as text.

    So numbers keep every digit, and an empty cell is an error where a number is expected.

    Args:
        file: its path, or the opened file.

    Raises:
        ValueError: for a file that is no text or empty, and for a row with more values than there
            are columns; one with fewer, as while it is written, is filled with "nan".
    """
    content = read_file(file, LARGEST_TABLE) if isinstance(file, Path) else file.read()
    try:
        lines = list(csv.reader(io.StringIO(content.decode("utf-8"), newline=""), strict=True))
    except csv.Error as error:
        raise ValueError(str(error)) from error
    if not lines or not lines[0]:
        raise ValueError("No columns")
    columns = lines[0]
    if len(set(columns)) < len(columns):
        raise ValueError("two columns of one name")
    rows = [line for line in lines[1:] if line]
    if any(len(row) > len(columns) for row in rows):
        raise ValueError("a row with more values than columns")
    return [dict(zip_longest(columns, row, fillvalue="nan")) for row in rows]
