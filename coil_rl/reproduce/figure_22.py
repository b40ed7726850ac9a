"""Figure 22 of the paper: how the return grows with training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.report import draw_learning_curves, markdown_table, write_csv
from coil_rl.report.curves import TRAINING, mean_curve
from coil_rl.report.runs import GUIDE
from coil_rl.reproduce.result import NO_RUNS, Result, Runs, called
from coil_rl.reproduce.verdict import with_interval

PARTS = {"quarter": (0.25, "a quarter"), "half": (0.5, "half"), "end": (1.0, "all")}

NOTES = """
The return is the mean over the last 100 finished episodes on the training tracks, actions sampled; the curve is the
mean of the runs, the band the 95 % bootstrap interval of that mean. The guide alone earns {guide} there. Up to the
guide: the first frames after which the mean of the runs is not below that. The paper draws three curves of each method
and prints no numbers."""


class Figure22(Result):
    """Learning curves, and the guide's own return as a line.

    Args:
        experiments: in one world.
        labels: that are drawn; the line is the guide of the first.
    """

    def __init__(self, experiments: Sequence[str], labels: Sequence[str] = ("coil", "ppo")) -> None:
        if not labels:
            raise ValueError("labels=[] draws nothing; give at least one")
        self.experiments, self.labels = list(experiments), list(labels)

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        learned = {experiment: [run for run in runs[experiment] if run.curve] for experiment in self.experiments}
        of_label = called(self.labels, learned)
        curves = {label: [run.curve for run in found] for label, found in of_label.items()}
        own = [max(run.guide_returns.values()) for run in of_label[self.labels[0]] if run.guide_returns]
        guide = float(np.mean(own)) if own else None
        rows, table = [], []
        for label, curve in curves.items():
            frames, mean, low, high = mean_curve(curve, TRAINING)
            points = zip(frames, mean, low, high, strict=True)
            rows += [dict(zip(("label", "frames", "mean", "low", "high"), (label, *p), strict=True)) for p in points]
            line: dict[str, Any] = {"label": label, "runs": len(curve)}
            for part, (share, _) in PARTS.items():
                line[part] = None
                if len(frames):
                    at = int(np.abs(frames - share * frames[-1]).argmin())
                    line[part] = with_interval(mean[at], *((low[at], high[at]) if len(curve) > 1 else (np.nan, np.nan)))
            passed = frames[mean >= guide] if guide is not None else frames[:0]
            table.append(line | {"passed": passed[0] if len(passed) else None})
        write_csv(rows, stem.with_suffix(".csv"))
        draw_learning_curves(
            curves, stem.with_suffix(".png"), guides={} if guide is None else {GUIDE: guide},
            title="Figure 22: the return in training",
        )  # fmt: skip
        columns = {"label": ("method", ""), "runs": ("runs", "d")}
        for part, (_, text) in PARTS.items():
            columns |= {part: (f"return after {text} of the frames (95 %)", "")}
        columns |= {"passed": ("frames up to the guide", ",.0f")}
        notes = NOTES.strip().format(guide="an unknown return" if guide is None else f"{guide:.1f}")
        return f"## Figure 22: learning curves\n\n{markdown_table(table, columns)}\n\n{notes}"
