"""Reads what finished runs left in their folders."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from coil_rl.errors import UserError

Array = NDArray[np.float64]

GUIDE = "guide"  # as `driver` calls it in evaluation.csv
MEASURES = ("reward", "lap_time", "smoothness", "completed", "crashed", "clearance")
PER_STEP = "per_step_"  # and the name of a task


@dataclass(frozen=True)
class Drive:
    """How one driver of a run did.

    Attributes:
        driver: "guide", or "guide NAME" where there are several; or the label of the run for its agent.
        advice: what was done to the advice, such as "zeroed"; empty if nothing was.
        actions: "deterministic" or "sampled".
        tracks: their names, in the order in which they were driven.
        values: [tracks, MEASURES, and the reward of a step in each task].
        tasks: their names; none where the env has none.
    """

    driver: str
    advice: str
    actions: str
    tracks: tuple[str, ...]
    values: Array
    tasks: tuple[str, ...] = ()

    @property
    def is_guide(self) -> bool:
        """Whether a guide drove."""
        return self.driver.split()[:1] == [GUIDE]


@dataclass(frozen=True)
class Run:
    """One training run.

    Attributes:
        folder: where it is.
        label: the group that it belongs to: its seeds share one.
        seed: of the run.
        needs_guide: whether the agent needs the guide when it drives; None if there is no agent.
        drives: its guide's and its agent's; none until the run is finished.
        curve: the rows of its metrics.csv; none if nothing was learned.
        guide_returns: each guide's mean return on the training tracks by its driver's name, if it was measured.
        seconds: that the training took; None where that is not known, as of a run that was stopped in between.
    """

    folder: Path
    label: str
    seed: int
    needs_guide: bool | None
    drives: tuple[Drive, ...] = ()
    curve: Sequence[dict[str, float]] = field(default=(), repr=False)
    guide_returns: Mapping[str, float] = field(default_factory=dict)
    seconds: float | None = None

    @property
    def finished(self) -> bool:
        """Whether its drivers have been judged."""
        return bool(self.drives)


def read_runs(folders: Sequence[Path]) -> list[Run]:
    """All runs in some folders, at any depth, in the order of their folders' names.

    Raises:
        UserError: if a folder is missing or holds no run, or if a file of a run is damaged.
    """
    found: dict[Path, Run] = {}
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"folder={folder} is not there; give a folder in which coil-train has left runs")
        places = [path.parent for path in sorted(folder.rglob("config.yaml")) if not _is_hidden(path, folder)]
        if not places:
            raise UserError(f"folder={folder} holds no run of coil-train: nothing in it has a config.yaml")
        # A folder that was given twice, or with the one around it, counts once.
        found |= {place.resolve(): _read(place) for place in places if place.resolve() not in found}
    return list(found.values())


def _is_hidden(path: Path, folder: Path) -> bool:
    """Whether this is Hydra's own copy of a configuration, in `.hydra`, or of what a run keeps for itself."""
    inside = path.relative_to(folder).parts
    above = [folder.joinpath(*inside[:depth]) for depth in range(len(inside) - 1)]
    return any(part.startswith(".") for part in inside) or any((place / path.name).exists() for place in above)


def _read(folder: Path) -> Run:
    path = folder / "config.yaml"
    try:
        config = OmegaConf.load(path)
        if not isinstance(config, DictConfig):
            raise ValueError("a list")
        label, seed = str(config["label"]), int(config["seed"])
        needs_guide = config["method"]["needs_guide"]
    except (OmegaConfBaseException, yaml.YAMLError, ValueError, TypeError, KeyError) as error:
        problem = " ".join(str(error).split("\n    full_key")[0].split())
        raise UserError(
            f"{path} has no label, seed and method.needs_guide to read ({problem}); "
            "put back the file that coil-train wrote, or take the run out of the folder"
        ) from error
    if not (folder / "evaluation.csv").exists():
        return Run(folder, label, seed, needs_guide)
    return Run(
        folder, label, seed, needs_guide,
        _drives(folder / "evaluation.csv"), _curve(folder / "metrics.csv"), _numbers(folder / "guide_return.json"),
        _numbers(folder / "training_time.json").get("seconds"),
    )  # fmt: skip


def _drives(path: Path) -> tuple[Drive, ...]:
    tracks: dict[tuple[str, str, str], dict[str, list[float]]] = {}
    rows = _rows(path)
    tasks = [key for key in rows[0] if key and key.startswith(PER_STEP)] if rows else []
    for row in rows:
        try:
            driver = (row["driver"], row["advice"], row["actions"])
            values = [float(row[measure]) for measure in (*MEASURES, *tasks)]
            if row["track"] != "mean":
                tracks.setdefault(driver, {})[row["track"]] = values
        except (KeyError, TypeError, ValueError) as error:
            raise _damaged(path, error) from error
    if not tracks:
        raise _damaged(path, ValueError("no rows"))
    return tuple(
        Drive(*driver, tuple(on), np.array(list(on.values())), tuple(task.removeprefix(PER_STEP) for task in tasks))
        for driver, on in tracks.items()
    )


def _curve(path: Path) -> list[dict[str, float]]:
    try:
        return [{key: float(value) for key, value in row.items()} for row in _rows(path)] if path.exists() else []
    except (TypeError, ValueError) as error:
        raise _damaged(path, error) from error


def _numbers(path: Path) -> dict[str, float]:
    try:
        return {key: float(value) for key, value in json.loads(path.read_text()).items()} if path.exists() else {}
    except (AttributeError, TypeError, ValueError) as error:
        raise _damaged(path, error) from error


def _rows(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file, strict=True))
    except (csv.Error, UnicodeDecodeError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> UserError:
    problem = f"no column {error}" if isinstance(error, KeyError) else str(error)
    return UserError(
        f"{path} is damaged ({problem}); remove the file and write it again by coil-train resume={path.parent}"
        if path.name == "evaluation.csv"
        else f"{path} is damaged ({problem}); put the whole file back, or take the run out of the folder"
    )
