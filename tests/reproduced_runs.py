"""Finished runs as the results of the paper take them, made in no time."""

import numpy as np
from run_folders import driven, make_run

from coil_rl.report import write_csv
from coil_rl.report.runs import read_runs

GUIDE = {"a": 500.0, "b": 600.0}


def make_runs(folder, gains, seeds=3, *, sampled=True, curve=True, **others):
    """Runs of labels that earn so much more than the guide, and a seed's number besides; by label the runs."""
    for label, gain in gains.items():
        for seed in range(seeds):
            rewards = {track: reward + gain + seed for track, reward in GUIDE.items()}
            rows = driven("guide", GUIDE) + driven(label, rewards, **others)
            rows += driven(label, {track: reward - 50 for track, reward in rewards.items()}, "sampled") * sampled
            run = make_run(folder / f"{label}_{seed}", label, seed, rows)
            returns = [np.nan, *(300 + gain + seed + np.array([0.0, 40.0, 20.0]))]
            frames = range(1000, 5000, 1000)
            points = [{"frames": n, "train/return": value} for n, value in zip(frames, returns, strict=True)]
            (run / "metrics.csv").unlink()
            if curve:
                write_csv(points, run / "metrics.csv")
    return read_runs([folder])
