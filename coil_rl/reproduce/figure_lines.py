"""The lines that the guide, imitation, PPO and COIL drive on tracks that none of them has seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig
from tqdm import tqdm

from coil_rl.envs.track import Track
from coil_rl.errors import UserError
from coil_rl.report import markdown_table, write_csv
from coil_rl.report.runs import Run
from coil_rl.report.straightened import Straightened
from coil_rl.reproduce.figure_lines_picture import draw_straightened
from coil_rl.reproduce.result import NO_RUNS, Result, Runs, called
from coil_rl.train import load
from coil_rl.train.build import build, build_env
from coil_rl.train.evaluate_run import drive_guides
from coil_rl.train.evaluation import EvaluationResult, evaluate_policy

COLUMNS = {
    "driver": ("driver", ""),
    "track": ("track", ""),
    "reward": ("reward", ".1f"),
    "lap_time": ("lap (s)", ".2f"),
    "smoothness": ("smoothness", ".3f"),
    "way": ("way / centre line", ".3f"),
    "off_centre": ("from the centre (m)", ".3f"),
    "crashed": ("crashed", ""),
}

NOTES = """
The policies are the {policy} ones of the runs with seed {seed}, their actions deterministic; the guide is that of
{first}. The picture shows the last lap of each on the track straightened along its middle, and below it |a - weighted
mean of the last 20 actions|. way / centre line: metres driven for each metre of the centre line that was passed, of who
came around; from the centre: the mean distance. Other seeds drive other lines; all of them are in table 5. The paper
prints no numbers of this."""


class FigureLines(Result):
    """Driven lines on straightened tracks, with the smoothness of steering below them.

    A run does not keep its lines, so its policy drives once more, in its own env with its own transforms.

    Args:
        experiments: whose runs it takes.
        labels: that drive, beside the guide of the first of them.
        seed: of the runs.
        tracks: how many of the tracks that the runs were judged on, the first ones.
        policy: last, or best: with the highest mean return of a training batch.
    """

    def __init__(
        self,
        experiments: Sequence[str],
        labels: Sequence[str] = ("oil", "ppo", "coil"),
        seed: int = 0,
        tracks: int = 3,
        policy: str = "last",
    ) -> None:
        if not labels:
            raise ValueError("labels=[] leaves the guide alone; give at least one")
        if tracks < 1:
            raise ValueError(f"tracks={tracks} must be at least 1")
        if policy not in ("last", "best"):
            raise ValueError(f"policy={policy} must be one of last, best")
        self.experiments, self.labels = list(experiments), list(labels)
        self.seed, self.tracks, self.policy = seed, tracks, policy

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        chosen = self._chosen({experiment: runs[experiment] for experiment in self.experiments})
        configs = {label: load.read_config(run.folder, "run", {"device": "cpu"}) for label, run in chosen.items()}
        first = configs[self.labels[0]]
        tracks: list[Track] = build(first.track.test, "track.test")[: self.tracks]
        names = [track.name for track in tracks]
        drives = drive_guides(first, first.evaluation.env, names)
        with tqdm(unit="step", desc="drive", leave=False, mininterval=0.5) as bar:
            for label, run in chosen.items():
                bar.set_postfix_str(label)
                drives[label] = self._driven(run.folder, configs[label], names, bar)
        straight = [Straightened(track) for track in tracks]
        rows = [
            {"driver": driver} | episode | _way(place, track.length, line, episode["laps"])
            for driver, of_driver in drives.items()
            for episode, line, place, track in zip(of_driver.episodes, of_driver.lines, straight, tracks, strict=True)
        ]
        write_csv(rows, stem.with_suffix(".csv"))
        title = f"Driven lines on unseen tracks, seed {self.seed}"
        draw_straightened(tracks, straight, drives, stem.with_suffix(".png"), title)
        notes = NOTES.strip().format(policy=self.policy, seed=self.seed, first=self.labels[0])
        return f"## Driven lines on unseen tracks\n\n{markdown_table(rows, COLUMNS)}\n\n{notes}"

    def _chosen(self, runs: Runs) -> dict[str, Run]:
        """The run of each label that has the seed."""
        found = {}
        for label, of_label in called(self.labels, runs).items():
            of_seed = [run for run in of_label if run.seed == self.seed]
            if not of_seed:
                known = ", ".join(map(str, sorted({run.seed for run in of_label})))
                raise UserError(f"{label} has no run with seed={self.seed}; it has {known}")
            found[label] = of_seed[0]
        return found

    def _driven(self, folder: Path, config: DictConfig, names: Sequence[str], bar: tqdm[Any]) -> EvaluationResult:
        """The agent of a run, on each track once."""
        env = build_env(config, {**config.evaluation.env, "num_cars": len(names)})
        policy = load.load_policy(folder, config, env, self.policy)
        return evaluate_policy(env, policy, names=names, tick=bar.update)


def _way(straight: Straightened, length: float, line: Any, laps: int) -> dict[str, float]:
    """How far the driver went for each metre of a centre line of this length, and how far from its middle it was."""
    along, aside = straight(line)
    passed = np.diff(np.unwrap(along, period=straight.length)).sum() / straight.length * length
    driven = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    return {"way": float(driven / passed) if laps else float("nan"), "off_centre": float(np.abs(aside).mean())}
