"""Finished runs of reproduced results, with invented numbers, and readers of the results."""

import numpy as np
from run_folders import driven, make_run

from coil_rl.report import write_csv
from coil_rl.report.runs import read_runs

GUIDE = {"a": 500.0, "b": 600.0}


def make_runs(folder, gains, seeds=3, *, sampled=True, curve=True, **others):
    """Return runs by label whose rewards exceed the guide's by the label's gain plus the seed."""
    for label, gain in gains.items():
        for seed in range(seeds):
            rewards = {case: reward + gain + seed for case, reward in GUIDE.items()}
            rows = driven("guide", GUIDE) + driven(label, rewards, **others)
            rows += (
                driven(label, {case: reward - 50 for case, reward in rewards.items()}, "sampled")
                * sampled
            )
            run = make_run(folder / f"{label}_{seed}", label, seed, rows)
            returns = [np.nan, *(300 + gain + seed + np.array([0.0, 40.0, 20.0]))]
            frames = range(1000, 5000, 1000)
            points = [
                {"frames": n, "evaluation/return": value, "selection/return": value}
                for n, value in zip(frames, returns, strict=True)
            ]
            (run / "metrics.csv").unlink()
            if curve:
                write_csv(points, run / "metrics.csv")
    return read_runs([folder])


def cells(line):
    """Return the cells of a line of a Markdown table."""
    return [cell.strip() for cell in line.split("|")[1:-1]]


def row(page, start, which=0):
    """Return the cells of a page's table row by the start of its text."""
    return cells([line for line in page.splitlines() if line.startswith(f"| {start}")][which])
