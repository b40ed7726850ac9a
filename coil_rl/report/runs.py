"""Configuration, evaluation and learning curve of finished runs, read from their folders."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pandas as pd
import yaml

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.plain_yaml import read_yaml
from coil_rl.report.measures import Measure, measures_of

GUIDE = "guide"  # in the column `driver` of evaluation.csv
DRIVER = ("driver", "advice", "actions", "case")
EVALUATION, SELECTION = (
    "evaluation",
    "selection",
)  # sets of cases: for reports, and for the choice of the best policy
RETURN, CHOICE = f"{EVALUATION}/return", f"{SELECTION}/return"  # columns of metrics.csv
PER_STEP = "per_step_"  # prefix of the measures of tasks
TERM = "reward_"  # prefix of the measures of the terms of the reward


@dataclass(frozen=True, eq=False)
class Run:
    """One training run."""

    folder: Path
    label: str  # shared by the seeds of one method
    seed: int
    needs_guide: (
        bool | None
    )  # whether the agent needs the guide during evaluation; None without an agent
    # One row per driver and case, empty until the run is finished: `driver` ("guide", "guide NAME"
    # for one of several, or the label), `advice` (its modification, such as "zeroed"; empty for
    # none), `actions` ("deterministic" or "sampled"), `case`, `reward`, and the measures.
    evaluation: pd.DataFrame = field(default_factory=pd.DataFrame, repr=False)
    measures: Mapping[str, Measure] = field(default_factory=dict, repr=False)  # definitions by name
    curve: Sequence[dict[str, float]] = field(
        default=(), repr=False
    )  # rows of metrics.csv; empty without training
    guide_returns: Mapping[str, float] = field(
        default_factory=dict
    )  # mean of each guide in the evaluation, if known
    seconds: float | None = (
        None  # duration of the training; None if unknown, as for an interrupted run
    )

    @property
    def finished(self) -> bool:
        """Whether the run has been evaluated."""
        return not self.evaluation.empty


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """Return all runs in some folders, at any depth, sorted by folder.

    A folder that is missing or holds no run, and a damaged file of a run, are a `UserError`.
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
        runs |= {
            path.resolve(): _read_run(path) for path in run_folders if path.resolve() not in runs
        }
    return list(runs.values())


def _is_run(config: Path, folder: Path) -> bool:
    """Return whether a config.yaml belongs to a run, not to `.hydra` or to a run inside of a run (a proxy)."""
    parts = config.relative_to(folder).parts
    outer = [folder.joinpath(*parts[:depth], config.name) for depth in range(len(parts) - 1)]
    return not any(part.startswith(".") for part in parts) and not any(
        path.exists() for path in outer
    )


def _read_run(folder: Path) -> Run:
    path = folder / "config.yaml"
    try:
        config = read_yaml(path)
        if not isinstance(config, dict):
            raise ValueError("a list")
        run = Run(
            folder, str(config["label"]), int(config["seed"]), config["method"]["needs_guide"]
        )
        measures = measures_of((config.get("evaluation") or {}).get("measures") or {})
    except (yaml.YAMLError, AttributeError, ValueError, TypeError, KeyError) as error:
        problem = " ".join(str(error).split())
        if isinstance(error, KeyError):
            problem = f"Missing key {error.args[0]}"
        remedy = "restore the file that coil-train wrote, or remove the run from the folder"
        raise UserError(
            f"{path} has no valid label, seed and method.needs_guide ({problem}); {remedy}"
        ) from error
    path = folder / "evaluation.csv"
    if not path.exists():
        return run
    with file_of_a_run(path, f"remove the file and write it again by coil-train resume={folder}"):
        evaluation = _read_evaluation(
            path, [name for name, measure in measures.items() if measure.title]
        )
    remedy = "restore the file, or remove the run from the folder"
    with file_of_a_run(path := folder / "metrics.csv", remedy):
        curve = read_curve(path) if path.exists() else []
    numbers = {}
    for name in ("guide_return", "training_time"):
        with file_of_a_run(path := folder / f"{name}.json", remedy):
            saved = json.loads(path.read_text()) if path.exists() else {}
            numbers[name] = {key: float(value) for key, value in saved.items()}
    returns, seconds = numbers["guide_return"], numbers["training_time"].get("seconds")
    return replace(
        run,
        evaluation=evaluation,
        measures=measures,
        curve=curve,
        guide_returns=returns,
        seconds=seconds,
    )


def _read_evaluation(path: Path, shown: Iterable[str]) -> pd.DataFrame:
    frame = _read_csv(path)
    if missing := [name for name in shown if name not in frame and set(DRIVER) <= set(frame)]:
        raise ValueError(f"no column {missing[0]}")
    numbers = ["reward", *(column for column in frame if column not in (*DRIVER, "reward"))]
    frame = frame[[*DRIVER, *numbers]].astype(dict.fromkeys(numbers, float))
    frame = frame[frame["case"] != "mean"]
    if frame.empty:
        raise ValueError("no rows")
    if frame.duplicated(list(DRIVER)).any():
        raise ValueError("two rows of one driver in the same case")
    return frame


def read_curve(file: Path | BinaryIO) -> list[dict[str, float]]:
    """Return the rows of a `metrics.csv`; raise a `ValueError` if a cell is no number or `frames` is missing."""
    frame = _read_csv(file).astype(float)
    if not np.isfinite(frame.get("frames", np.nan)).all():
        raise ValueError("not every row has its number of frames")
    return frame.to_dict("records")


def _read_csv(path: Path | BinaryIO) -> pd.DataFrame:
    """Read all cells as text: numbers keep every digit, and an empty cell is an error where a number is expected."""
    frame = pd.read_csv(path, dtype=str, keep_default_na=False)
    if not isinstance(frame.index, pd.RangeIndex):
        raise ValueError("a row with more values than columns")
    return frame
