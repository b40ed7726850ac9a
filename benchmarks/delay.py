"""Which agents survive a late view: crashes by delay, with cones missing or not.

`coil-train +experiment=robot_delay` trains the runs, and this program drives them:

    python -m benchmarks.delay outputs/experiments/robot_delay

Each policy that a run handed over drives 20 copies of the robot's track whose cones are moved a
little, whole and with a tenth of the cones missing, with views that are late by a fixed number of
turns of the LiDAR. A control step is a turn, so half of a turn is an average: each episode draws
none or one. The unit is the seed: crashes of a seed are those of its 20 episodes, and an interval
is that of the mean over seeds.
"""

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, open_dict

from coil_rl.config.assemble import assemble
from coil_rl.config.folder import read_config
from coil_rl.files import write_text
from coil_rl.report import markdown_table, write_csv
from coil_rl.report.statistics import interval
from coil_rl.run.evaluation import EvaluationResult
from coil_rl.run.parts import SOME_ROWS, TEST
from coil_rl.run.policy_batch import Acting, OnRows
from coil_rl.run.run import Run

LAGS = {"0": (0, 0), "0.5": (0, 1), "1": (1, 1), "2": (2, 2)}  # least and most steps, by turns
MISSING = (0.0, 0.1)  # share of the cones
GUIDE = "guide"
COLUMNS = {
    "label": ("trained", ""),
    "missing": ("cones missing", ".0%"),
    "turns": ("late by turns", ""),
    "seeds": ("seeds", "d"),
    "crashed": ("crashed", ".0%"),
    "low": ("from", ".0%"),
    "high": ("to", ".0%"),
    "completed": ("completed", ".0%"),
    "smoothness": ("smoothness", ".3f"),
    "by_seed": ("crashed of 20, by seed", ""),
}


def runs_by_label(folder: Path) -> dict[str, list[Path]]:
    """Return the folders of finished runs by their labels, those of a label by their seeds."""
    found: dict[str, list[tuple[int, Path]]] = {}
    for file in sorted(folder.glob("*/evaluation.csv")):
        config = read_config(file.parent, "run", {"device": "cpu"})
        found.setdefault(config.label, []).append((config.seed, file.parent))
    return {label: [path for _, path in sorted(runs)] for label, runs in found.items()}


def late_run(folder: Path, lags: tuple[int, int], missing: float, count: int) -> Run:
    """Return a run with another evaluation: on the robot's track, with a late view.

    Args:
        lags: least and most steps by which the view is late.
        missing: share of the cones that is missing.
    """
    config: DictConfig = read_config(folder, "run", {"device": "cpu"})
    tracks = {
        "_target_": "coil_rl.envs.robot_tracks",
        "scale": 7.0,
        "count": count,
        "missing": missing,
        "moved": 0.015,
    }
    delay = {
        "_target_": "coil_rl.transforms.ObservationDelay",
        "min_lag": lags[0],
        "max_lag": lags[1],
        "seed": 0,
    }
    with open_dict(config):
        config.track.test = tracks
        config.evaluation.cases = {"_target_": "coil_rl.envs.track_names", "tracks": tracks}
        config.evaluation.env.tracks = tracks
        config.evaluation.pictures = {}
        config.disturb = {"observation_delay": delay}
        config.evaluation.disturb = {}
    return assemble(config)


def driven(
    folders: Sequence[Path], lags: tuple[int, int], missing: float, count: int
) -> list[EvaluationResult]:
    """Return the episodes of the policy of each run, which are of one label."""
    runs = [late_run(folder, lags, missing, count) for folder in folders]
    trial = runs[0].trial
    policies = [run.policy(trial.env(SOME_ROWS)) for run in runs]
    beside = OnRows(list(map(Acting, policies)))
    result = trial.evaluation.run(trial.env(len(runs) * count), beside)
    return [result[index * count : (index + 1) * count] for index in range(len(runs))]


def guide_driven(
    folder: Path, lags: tuple[int, int], missing: float, count: int
) -> list[EvaluationResult]:
    """Return the episodes of the guide of a run, alone."""
    run = late_run(folder, lags, missing, count)
    env, policy = run.make_env.guided(count, TEST)
    return [run.trial.evaluation.run(env, policy)]


def row_of(label: str, turns: str, missing: float, results: Sequence[Any]) -> dict[str, Any]:
    """Return a row of the table.

    Args:
        turns: by which the view was late.
        missing: share of the cones.
        results: episodes by seed.
    """

    def shares(name: str) -> np.ndarray:
        return np.array([np.mean([row[name] for row in each.episodes]) for each in results])

    crashed = interval(shares("crashed"))
    counts = [sum(bool(row["crashed"]) for row in each.episodes) for each in results]
    return {
        "label": label,
        "missing": missing,
        "turns": turns,
        "seeds": len(results),
        "crashed": crashed.mean,
        "low": crashed.low,
        "high": crashed.high,
        "completed": float(shares("completed").mean()),
        "smoothness": float(shares("smoothness").mean()),
        "by_seed": " ".join(map(str, counts)),
    }


def rows_of(
    labels: Mapping[str, Sequence[Path]],
    count: int,
    late: Sequence[str] = tuple(LAGS),
    shares: Sequence[float] = MISSING,
) -> Iterator[dict[str, Any]]:
    """Yield the rows of all labels, those of the guide alone first.

    Args:
        labels: folders of runs by label.
        late: by how many turns, names in `LAGS`.
    """
    first = next(iter(labels.values()))[0]
    cases = [(missing, turns) for missing in shares for turns in late]
    for missing, turns in cases:
        yield row_of(GUIDE, turns, missing, guide_driven(first, LAGS[turns], missing, count))
    for label, folders in labels.items():
        for missing, turns in cases:
            yield row_of(label, turns, missing, driven(folders, LAGS[turns], missing, count))


def main() -> None:
    """Drive, print the table row by row, and write it into the folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of coil-train +experiment=robot_delay")
    parser.add_argument("--count", type=int, default=20, help="copies of the track")
    parser.add_argument("--turns", nargs="+", choices=LAGS, default=[*LAGS], help="of delay")
    parser.add_argument("--missing", nargs="+", type=float, default=MISSING, help="share of cones")
    args = parser.parse_args()
    torch.set_num_threads(1)
    labels = runs_by_label(args.folder)
    if not labels:
        raise SystemExit(f"{args.folder} has no finished runs")
    rows: list[dict[str, Any]] = []
    for row in rows_of(labels, args.count, args.turns, args.missing):
        rows.append(row)
        print(*(row[name] for name in COLUMNS), flush=True)
    page = markdown_table(rows, COLUMNS)
    write_text(args.folder / "delay.md", page)
    write_csv(rows, args.folder / "delay.csv")
    print(page)


if __name__ == "__main__":
    main()
