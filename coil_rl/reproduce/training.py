"""Table 4 and figure 22 of the paper: the return of the policies of a training run."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.report import Interval, draw_intervals, draw_learning_curves, markdown_table, write_csv
from coil_rl.report.curves import frames_until, learning, mean_curve
from coil_rl.report.runs import GUIDE, RETURN
from coil_rl.report.statistics import Estimate, estimate, wins
from coil_rl.reproduce import pages
from coil_rl.reproduce.result import NO_RUNS, PAGES, Result, Runs, WorldsResult, runs_by_label

Row = Mapping[str, Any]

PAPER_RETURNS = PAGES["table_4"]["paper"]
KEYS = ("best", "final", "guide")
FRACTIONS = {0.25: "a quarter", 0.5: "half", 1.0: "all"}  # of the frames


class Table4(WorldsResult):
    """Return of the best and of the last policy of each method."""

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        rows = {
            world: [
                {"label": run.label, "seed": run.seed} | learning(run)
                for experiment in experiments
                for run in runs[experiment]
                if run.curve
            ]
            for world, experiments in self.worlds.items()
        }
        write_csv([{"world": world} | row for world in rows for row in rows[world]], stem.with_suffix(".csv"))
        tables = {world: self._table(of_world) for world, of_world in rows.items()}
        _draw_returns(rows[""], tables[""], self.against, stem.with_suffix(".png"))
        columns = {
            "label": ("method", ""), "runs": ("runs", "d"), "best cell": ("best: mean (95 %)", ""),
            "final cell": ("final: mean (95 %)", ""),
            "guide": ("its guide", ".1f"), "difference cell": (f"best - {self.against}'s (95 %)", ""),
            "better": (f"better than {self.against}", ".0%"),
        }  # fmt: skip
        parts = ["## Table 4: the return of the trained policies", _paper_table(tables[""])]
        for world, table in tables.items():
            parts += [*pages.world_heading(world), markdown_table(table, columns)]
        parts += [PAGES["table_4"]["notes"].format(against=self.against)]
        claims = []
        for world, table in tables.items():
            for line in table:
                if line["label"] == "coil" and self.against == "ppo":
                    claim = ", ".join(filter(None, ("COIL's best return is above PPO's", world)))
                    paper = f"{PAPER_RETURNS['coil'] - PAPER_RETURNS['ppo']:+.1f}"
                    claims.append({"claim": claim, "paper": paper, "ours": pages.Claim(line["difference"], "+.1f")})
        if claims:
            parts.append(pages.claims_section(claims, {"paper": "paper", "ours": "ours (95 %)"}))
        return "\n\n".join(parts)

    def _table(self, rows: Sequence[Row]) -> list[dict[str, Any]]:
        """Return one row per label, the best first."""
        by_label: dict[str, dict[int, Row]] = {}
        for row in rows:
            by_label.setdefault(row["label"], {})[row["seed"]] = row
        reference = by_label.get(self.against, {})
        table = []
        for label, by_seed in by_label.items():
            best, final, guide = (np.array([row[key] for row in by_seed.values()]) for key in KEYS)
            common = [seed for seed in by_seed if seed in reference and label != self.against]
            ours, theirs = (np.array([seeds[seed]["best"] for seed in common]) for seeds in (by_seed, reference))
            line: dict[str, Any] = {"label": label, "runs": len(by_seed), "guide": guide.mean()}
            line["better"] = float(wins(ours[:, None], theirs[:, None]).mean()) if common else None
            for key, values in {"best": best, "final": final, "difference": ours - theirs}.items():
                line[key] = estimate(values)
                line[f"{key} cell"] = line[key].cell("+.1f" if key == "difference" else ".1f")
            table.append(line)
        return sorted(table, key=lambda line: -line["best"].mean if math.isfinite(line["best"].mean) else math.inf)


class Figure22(Result):
    """Learning curves of the runs with some labels in one world, with the return of the first one's guide as a line."""

    def __init__(self, experiments: Sequence[str], labels: Sequence[str] = ("coil", "ppo")) -> None:
        if not labels:
            raise ValueError("labels=[] draws nothing; give at least one")
        self.experiments, self.labels = list(experiments), list(labels)

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        learned = {experiment: [run for run in runs[experiment] if run.curve] for experiment in self.experiments}
        by_label = runs_by_label(self.labels, learned)
        curves = {label: [run.curve for run in of_label] for label, of_label in by_label.items()}
        own = [max(run.guide_returns.values()) for run in by_label[self.labels[0]] if run.guide_returns]
        guide = float(np.mean(own)) if own else None
        rows, table = [], []
        for label, of_label in curves.items():
            curve = mean_curve(of_label, RETURN)
            rows += [
                {"label": label, "frames": frames, "mean": mean, "low": low, "high": high}
                for frames, mean, low, high in zip(*curve, strict=True)
            ]
            frames, mean, low, high = curve
            line: dict[str, Any] = {"label": label, "runs": len(of_label)}
            for fraction in FRACTIONS:
                line[str(fraction)] = None
                if len(frames):
                    at = int(np.abs(frames - fraction * frames[-1]).argmin())
                    ends = (low[at], high[at]) if len(of_label) > 1 else (np.nan, np.nan)
                    line[str(fraction)] = Estimate(mean[at], *ends).cell(".1f")
            table.append(line | {"reached": None if guide is None else frames_until(frames, mean, guide)})
        write_csv(rows, stem.with_suffix(".csv"))
        draw_learning_curves(
            curves, stem.with_suffix(".png"), guides={} if guide is None else {GUIDE: guide},
            title="Figure 22: the return of the trained policies",
        )  # fmt: skip
        columns = {"label": ("method", ""), "runs": ("runs", "d")}
        columns |= {str(f): (f"return after {text} of the frames (95 %)", "") for f, text in FRACTIONS.items()}
        columns |= {"reached": ("frames up to the guide", ",.0f")}
        notes = PAGES["figure_22"]["notes"].format(guide="an unknown return" if guide is None else f"{guide:.1f}")
        return f"## Figure 22: learning curves\n\n{markdown_table(table, columns)}\n\n{notes}"


def _paper_table(table: Sequence[Row]) -> str:
    """Return the table of COIL and PPO next to the paper."""
    by_label = {line["label"]: line for line in table}
    rows: list[dict[str, Any]] = [{"source": "paper, best", **PAPER_RETURNS}]
    for key in ("best", "final"):
        ours = {label: by_label[label][key].mean if label in by_label else None for label in PAPER_RETURNS}
        rows.append({"source": f"ours, {key}"} | ours)
    for row in rows:
        coil, ppo = row["coil"], row["ppo"]
        row["ratio"] = coil / ppo - 1 if coil is not None and ppo is not None and ppo > 0 else None
    return markdown_table(rows, {
        "source": ("mean over runs", ""), "coil": ("COIL", ".1f"), "ppo": ("RL (PPO)", ".1f"),
        "ratio": ("COIL over RL", "+.1%"),
    })  # fmt: skip


def _draw_returns(rows: Sequence[Row], table: Sequence[Row], against: str, path: Path) -> None:
    # One guide for all: guides with placebo advice would only stretch the axis.
    guide = next((line["guide"] for line in table if line["label"] == against and math.isfinite(line["guide"])), None)
    panels = {
        key: [
            Interval(
                line["label"], line[key].mean, line[key].low, line[key].high, guide=guide,
                points=[row[key] for row in rows if row["label"] == line["label"]] if line["runs"] > 1 else [],
            )
            for line in table
        ]
        for key in ("best", "final")
    }  # fmt: skip
    title = "Table 4: the return of the trained policies"
    draw_intervals(panels, path, measure="return (mean of the runs)", title=title)
