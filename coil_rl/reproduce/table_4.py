"""Table 4 of the paper: how far the return rises in training."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.report import Interval, draw_intervals, markdown_table, write_csv
from coil_rl.report.curves import TRAINING, points
from coil_rl.report.runs import Run
from coil_rl.report.statistics import iqm, stratified_bootstrap, wins
from coil_rl.reproduce.result import NO_RUNS, Runs
from coil_rl.reproduce.verdict import HEADING, verdict, with_interval
from coil_rl.reproduce.worlds import OfWorlds, heading

PAPER = {"coil": 477.6, "ppo": 414.2}  # average over 5 runs of the highest mean reward seen in training

COLUMNS = {
    "label": ("method", ""),
    "runs": ("runs", "d"),
    "best cell": ("best: mean (95 %)", ""),
    "best_iqm cell": ("best: IQM (95 %)", ""),
    "final cell": ("final: mean (95 %)", ""),
    "guide": ("its guide", ".1f"),
    "difference cell": ("best - {against}'s (95 %)", ""),
    "better": ("better than {against}", ".0%"),
}

NOTES = """
The return of a run is the mean over its last 100 finished episodes on the training tracks, actions sampled; best: the
highest that was seen, as in the paper; final: the last one. The highest of a noisy curve is above what the policy is
worth, the more so the longer the run. Differences to {against} are of the same seed; better: the share of seeds with a
higher best. Intervals: percentile bootstrap of whole seeds, {resamples} resamples; with five seeds they hold the mean
in about 85 of 100 cases. Its guide: the guide alone on the training tracks, made worse as the agent's was."""


class Table4(OfWorlds):
    """The best and the final return of each method in training."""

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        of_worlds = {
            world: [returns(run) for experiment in experiments for run in runs[experiment] if run.curve]
            for world, experiments in self.worlds.items()
        }
        write_csv(
            [{"world": world} | row for world, rows in of_worlds.items() for row in rows], stem.with_suffix(".csv")
        )
        tables = {world: self._table(rows) for world, rows in of_worlds.items()}
        _draw(of_worlds[""], tables[""], self.against, stem.with_suffix(".png"))
        headings = {key: (text.format(against=self.against), spec) for key, (text, spec) in COLUMNS.items()}
        parts = ["## Table 4: the return in training", _beside(tables[""])]
        for world, table in tables.items():
            parts += [*heading(world), markdown_table(table, headings)]
        parts += [NOTES.strip().format(against=self.against, resamples=self.resamples), *self._held_up(tables)]
        return "\n\n".join(parts)

    def _table(self, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """One row a label, the best first."""
        of_label: dict[str, dict[int, Mapping[str, Any]]] = {}
        for row in rows:
            of_label.setdefault(row["label"], {})[row["seed"]] = row
        other = of_label.get(self.against, {})
        table = []
        for label, by_seed in of_label.items():
            best, final = (np.array([row[key] for row in by_seed.values()]) for key in ("best", "final"))
            common = [seed for seed in by_seed if seed in other and label != self.against]
            ours, theirs = (np.array([found[seed]["best"] for seed in common]) for found in (by_seed, other))
            line = {"label": label, "runs": len(by_seed), "guide": np.mean([r["guide"] for r in by_seed.values()])}
            for name, values, statistic in (
                ("best", best, np.mean), ("best_iqm", best, iqm), ("final", final, np.mean),
                ("difference", ours - theirs, np.mean),
            ):  # fmt: skip
                line |= self._measured(name, values, statistic)
            line["better"] = float(wins(ours[:, None], theirs[:, None]).mean()) if common else None
            table.append(line)
        return sorted(table, key=lambda line: -line["best"] if math.isfinite(line["best"]) else math.inf)

    def _measured(self, name: str, values: NDArray[np.float64], statistic: Any) -> dict[str, Any]:
        """A statistic of the seeds and the ends of its interval."""
        value = low = high = math.nan
        if values.size and np.isfinite(values).all():
            value = float(statistic(values))
            low, high = stratified_bootstrap(values[:, None], statistic, resamples=self.resamples, seed=self.seed)
        cell = with_interval(value, low, high, "+.1f" if name == "difference" else ".1f")
        return {name: value, f"{name}_low": low, f"{name}_high": high, f"{name} cell": cell}

    def _held_up(self, tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[str]:
        rows = []
        for world, table in tables.items():
            coil = next((line for line in table if line["label"] == "coil"), None)
            if coil is not None and self.against == "ppo":
                ends = (coil["difference"], coil["difference_low"], coil["difference_high"])
                claim = ", ".join(filter(None, ("COIL's best return in training is above PPO's", world)))
                rows.append({"claim": claim, "paper": PAPER["coil"] - PAPER["ppo"], "ours": verdict(*ends, "+.1f")})
        columns = {"claim": ("the paper says", ""), "paper": ("paper", "+.1f"), "ours": ("ours (95 %)", "")}
        return [HEADING, markdown_table(rows, columns)] if rows else []


def returns(run: Run) -> dict[str, Any]:
    """What a run earned in training: the best return, after how many frames, and the final one; NaN for none."""
    known = [(value, frames) for frames, value in points(run.curve, TRAINING).tolist()]
    best, at = max(known, key=lambda point: point[0], default=(math.nan, math.nan))
    return {
        "label": run.label, "seed": run.seed, "frames": run.curve[-1]["frames"], "best": best, "best_at": at,
        "final": known[-1][0] if known else math.nan, "guide": max(run.guide_returns.values(), default=math.nan),
    }  # fmt: skip


def _beside(table: Sequence[Mapping[str, Any]]) -> str:
    """COIL and PPO beside the paper's."""
    found = {line["label"]: line for line in table}
    rows: list[dict[str, Any]] = [
        {"whose": f"ours, {key}"} | {label: found[label][key] if label in found else None for label in PAPER}
        for key in ("best", "final")
    ]
    rows.insert(0, {"whose": "paper, best", **PAPER})
    for row in rows:
        coil, ppo = row["coil"], row["ppo"]
        row["ratio"] = coil / ppo - 1 if coil is not None and ppo is not None and ppo > 0 else None
    return markdown_table(rows, {
        "whose": ("mean over runs", ""), "coil": ("COIL", ".1f"), "ppo": ("RL (PPO)", ".1f"),
        "ratio": ("COIL over RL", "+.1%"),
    })  # fmt: skip


def _draw(rows: Sequence[Mapping[str, Any]], table: Sequence[Mapping[str, Any]], against: str, path: Path) -> None:
    # One line to beat for all: placebos that drive would only stretch the axis.
    guide = next((line["guide"] for line in table if line["label"] == against), math.nan)

    def line(of_label: Mapping[str, Any], key: str) -> Interval:
        of_seeds = [row[key] for row in rows if row["label"] == of_label["label"]]
        return Interval(
            of_label["label"], of_label[key], of_label[f"{key}_low"], of_label[f"{key}_high"],
            points=of_seeds if len(of_seeds) > 1 else [],
            guide=guide if math.isfinite(guide) else None,
        )  # fmt: skip

    panels = {key: [line(of_label, key) for of_label in table] for key in ("best", "final")}
    draw_intervals(panels, path, measure="return (mean of the runs)", title="Table 4: the return in training")
