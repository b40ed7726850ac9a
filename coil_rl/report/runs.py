"""Configuration, evaluation and learning curve of finished runs, read from their folders."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pandas as pd
import yaml
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from coil_rl.errors import UserError, file_of_a_run
from coil_rl.train.trust import read_yaml

GUIDE = "guide"  # in the column `driver` of evaluation.csv
DRIVER = ("driver", "advice", "actions", "track")
MEASURES = ("reward", "lap_time", "smoothness", "completed", "crashed", "clearance")
EVALUATION, SELECTION = "evaluation", "selection"  # sets of cases: for reports, and for the choice of the best policy
RETURN, CHOICE = f"{EVALUATION}/return", f"{SELECTION}/return"  # columns of metrics.csv
PER_STEP = "per_step_"  # prefix of the columns of tasks
TERM = "reward_"  # prefix of the columns of the terms of the reward


@dataclass(frozen=True, eq=False)
class Run:
    """One training run.

    Attributes:
        folder: of the run.
        label: name shared by the seeds of one method.
        seed: of the run.
        needs_guide: whether the agent needs the guide during evaluation; None without an agent.
        evaluation: one row per driver and track, empty until the run is finished: `driver` ("guide", "guide NAME" for
            one of several, or the label), `advice` (its modification, such as "zeroed"; empty for none), `actions`
            ("deterministic" or "sampled"), `track`, MEASURES, for each task `per_step_TASK`, and for each term of the
            reward `reward_TERM`.
        curve: rows of metrics.csv; empty if nothing was trained.
        guide_returns: mean return of each guide in the cases of the evaluation, if it was measured.
        seconds: duration of the training; None if unknown, as for an interrupted run.
    """

    folder: Path
    label: str
    seed: int
    needs_guide: bool | None
    evaluation: pd.DataFrame = field(default_factory=pd.DataFrame, repr=False)
    curve: Sequence[dict[str, float]] = field(default=(), repr=False)
    guide_returns: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None

    @property
    def finished(self) -> bool:
        """Whether the run has been evaluated."""
        return not self.evaluation.empty


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """Return all runs in some folders, at any depth, sorted by folder.

    Raises:
        UserError: if a folder is missing or holds no run, or a file of a run is damaged.
    """
    runs: dict[Path, Run] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"folder={folder} does not exist; give a folder with runs of coil-train")
        run_folders = [path.parent for path in sorted(folder.rglob("config.yaml")) if _is_run(path, folder)]
        if not run_folders:
            raise UserError(f"folder={folder} holds no run of coil-train: nothing in it has a config.yaml")
        # Overlapping folders may hold the same run.
        runs |= {path.resolve(): _read_run(path) for path in run_folders if path.resolve() not in runs}
    return list(runs.values())


def _is_run(config: Path, folder: Path) -> bool:
    """Return whether a config.yaml belongs to a run, not to `.hydra` or to a run inside of a run (a proxy)."""
    parts = config.relative_to(folder).parts
    outer = [folder.joinpath(*parts[:depth], config.name) for depth in range(len(parts) - 1)]
    return not any(part.startswith(".") for part in parts) and not any(path.exists() for path in outer)


def _read_run(folder: Path) -> Run:
    path = folder / "config.yaml"
    try:
        config = read_yaml(path)
        if not isinstance(config, DictConfig):
            raise ValueError("a list")
        run = Run(folder, str(config["label"]), int(config["seed"]), config["method"]["needs_guide"])
    except (OmegaConfBaseException, yaml.YAMLError, ValueError, TypeError, KeyError) as error:
        problem = " ".join(str(error).split("\n    full_key")[0].split())
        raise UserError(
            f"{path} has no valid label, seed and method.needs_guide ({problem}); "
            "restore the file that coil-train wrote, or remove the run from the folder"
        ) from error
    path = folder / "evaluation.csv"
    if not path.exists():
        return run
    with file_of_a_run(path, f"remove the file and write it again by coil-train resume={folder}"):
        evaluation = _read_evaluation(path)
    remedy = "restore the file, or remove the run from the folder"
    with file_of_a_run(path := folder / "metrics.csv", remedy):
        curve = read_curve(path) if path.exists() else []
    numbers = {}
    for name in ("guide_return", "training_time"):
        with file_of_a_run(path := folder / f"{name}.json", remedy):
            numbers[name] = _read_numbers(path)
    guide_returns, seconds = numbers["guide_return"], numbers["training_time"].get("seconds")
    return Run(folder, run.label, run.seed, run.needs_guide, evaluation, curve, guide_returns, seconds)


def _read_evaluation(path: Path) -> pd.DataFrame:
    frame = _read_csv(path)
    numbers = [*MEASURES, *(column for column in frame if column.startswith((PER_STEP, TERM)))]
    frame = frame[[*DRIVER, *numbers]].astype(dict.fromkeys(numbers, float))
    frame = frame[frame["track"] != "mean"]
    if frame.empty:
        raise ValueError("no rows")
    return frame


def read_curve(file: Path | BinaryIO) -> list[dict[str, float]]:
    """Return the rows of a `metrics.csv`; raise a `ValueError` if a cell is no number or `frames` is missing."""
    frame = _read_csv(file).astype(float)
    if not np.isfinite(frame.get("frames", np.nan)).all():
        raise ValueError("not every row has its number of frames")
    rows: list[dict[str, float]] = frame.to_dict("records")
    return rows


def _read_csv(path: Path | BinaryIO) -> pd.DataFrame:
    """Read all cells as text: numbers keep every digit, and an empty cell is an error where a number is expected."""
    frame = pd.read_csv(path, dtype=str, keep_default_na=False)
    if not isinstance(frame.index, pd.RangeIndex):
        raise ValueError("a row with more values than columns")
    return frame


def _read_numbers(path: Path) -> dict[str, float]:
    return {key: float(value) for key, value in json.loads(path.read_text()).items()} if path.exists() else {}
