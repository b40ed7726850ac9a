"""Table 4 and figure 22 of the paper: the return of the policies of a training run."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from coil_rl.report import Interval, draw_intervals, draw_learning_curves, markdown_table, write_csv
from coil_rl.report.curves import frames_until, learning, mean_curve, points
from coil_rl.report.runs import GUIDE, RETURN, Run
from coil_rl.report.statistics import Array, Estimate, estimate, wins
from coil_rl.reproduce import pages
from coil_rl.reproduce.result import NO_RUNS, PAGES, Runs, WorldsResult, runs_by_label

Row = Mapping[str, Any]

PAPER_RETURNS = PAGES["table_4"]["paper"]
KEYS = ("best", "final", "guide")
FRACTIONS = {0.1: "a tenth", 0.25: "a quarter", 0.5: "half", 1.0: "all"}  # of the frames
POINT = ("frames", "mean", "low", "high")  # of a curve


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
        write_csv(
            [{"world": world} | row for world in rows for row in rows[world]],
            stem.with_suffix(".csv"),
        )
        tables = {world: self._table(of_world) for world, of_world in rows.items()}
        _draw_returns(rows[""], tables[""], self.against, stem.with_suffix(".png"))
        columns = {
            "label": ("method", ""),
            "runs": ("runs", "d"),
            "best cell": ("best: mean (95 %)", ""),
            "final cell": ("final: mean (95 %)", ""),
            "guide": ("its guide", ".1f"),
            "difference cell": (f"best - {self.against}'s (95 %)", ""),
            "better": (f"better than {self.against}", ".0%"),
        }
        parts = ["## Table 4: the return of the trained policies", _paper_table(tables[""])]
        for world, table in tables.items():
            parts += [*pages.world_heading(world), markdown_table(table, columns)]
        parts += [PAGES["table_4"]["notes"].format(against=self.against)]
        claims = []
        coil = [
            (world, line)
            for world, table in tables.items()
            for line in table
            if line["label"] == "coil"
        ]
        for world, line in coil if self.against == "ppo" else []:
            row = {"world": world, "claim": "COIL's best return is above PPO's"}
            paper = f"{PAPER_RETURNS['coil'] - PAPER_RETURNS['ppo']:+.1f}"
            claims.append({**row, "paper": paper, "ours": pages.Claim(line["difference"], "+.1f")})
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
            ours, theirs = (
                np.array([seeds[seed]["best"] for seed in common]) for seeds in (by_seed, reference)
            )
            line: dict[str, Any] = {"label": label, "runs": len(by_seed), "guide": guide.mean()}
            line["better"] = float(wins(ours[:, None], theirs[:, None]).mean()) if common else None
            for key, values in {"best": best, "final": final, "difference": ours - theirs}.items():
                line[key] = estimate(values)
                line[f"{key} cell"] = line[key].cell("+.1f" if key == "difference" else ".1f")
            table.append(line)
        return sorted(
            table,
            key=lambda line: -line["best"].mean if math.isfinite(line["best"].mean) else math.inf,
        )


class Figure22(WorldsResult):
    """Learning curves of the runs with some labels, with the return of the guide of the first one as a line.

    A label is drawn in every world that has runs of it. Variants of the main world have pictures of
    their own, `stem_2.png` and so on.
    """

    def __init__(
        self,
        experiments: Sequence[str],
        labels: Sequence[str] = ("coil", "ppo"),
        worlds: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        super().__init__(experiments, worlds)
        if not labels:
            raise ValueError("labels=[] draws nothing; give at least one")
        self.labels = list(labels)

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        learned = {name: [run for run in runs[name] if run.curve] for name in self.experiments}
        runs_by_label(self.labels, learned)  # each has runs in some world
        parts, rows, claims = ["## Figure 22: learning curves"], list[Row](), list[Row]()
        for number, (world, experiments) in enumerate(self.worlds.items(), start=1):
            of_world = [run for experiment in experiments for run in learned[experiment]]
            by_label = {
                label: [run for run in of_world if run.label == label] for label in self.labels
            }
            by_label = {label: of_label for label, of_label in by_label.items() if of_label}
            curves = {
                label: [run.curve for run in of_label] for label, of_label in by_label.items()
            }
            own = [
                max(run.guide_returns.values())
                for run in next(iter(by_label.values()))
                if run.guide_returns
            ]
            guide = float(np.mean(own)) if own else math.nan
            means = {label: mean_curve(of_label, RETURN) for label, of_label in curves.items()}
            for label, curve in means.items():
                values = [
                    dict(zip(POINT, point, strict=True)) for point in zip(*curve, strict=True)
                ]
                rows += [{"world": world, "label": label, **point} for point in values]
            reached = {label: _frames_to(guide, of_label) for label, of_label in by_label.items()}
            picture = stem.with_name(f"{stem.name}_{number}.png" if world else f"{stem.name}.png")
            title = ", ".join(
                filter(None, ("Figure 22: the return of the trained policies", world))
            )
            guides = {} if math.isnan(guide) else {GUIDE: guide}
            draw_learning_curves(curves, picture, guides=guides, title=title)
            parts += [
                *pages.world_heading(world),
                *([f"![{title}]({picture.name})"] if world else []),
            ]
            parts += [_curve_table(means, by_label, reached)]
            parts += (
                [] if math.isnan(guide) else [f"The guide alone earns {guide:.1f} in these cases."]
            )
            claims += _claims(means, reached, world)
        write_csv(rows, stem.with_suffix(".csv"))
        parts.append(PAGES["figure_22"]["notes"])
        parts += [pages.claims_section(claims, {"ours": "ours (95 %)"})] if claims else []
        return "\n\n".join(parts)


def _claims(
    means: Mapping[str, Sequence[Array]], reached: Mapping[str, Mapping[int, float]], world: str
) -> list[Row]:
    """Return the verdicts on the learning curves in one world, as rows of `claims_section`."""
    claims: list[Row] = []
    for claim, driver, other in PAGES["figure_22"]["claims"]:
        if not {driver, other} <= reached.keys():
            continue
        if claim == "above":
            (frames, mean, *_), (_, others, *_) = means[driver], means[other]
            above = (mean > others)[frames > 0]  # both begin untrained
            ours: Any = pages.certain_verdict(
                bool(above.all()), f"at {above.sum()} of {len(above)} points"
            )
        else:
            seeds = sorted(reached[driver].keys() & reached[other].keys())
            more = [reached[driver][seed] - reached[other][seed] for seed in seeds]
            ours = pages.Claim(estimate(more), "+,.0f", -1)
        text = PAGES["figure_22"]["texts"][claim].format(driver=driver, other=other)
        claims.append({"world": world, "claim": text, "ours": ours})
    return claims


def _frames_to(level: float, runs: Sequence[Run]) -> dict[int, float]:
    """Return by seed after how many frames a curve first reaches a level; all frames of the run if it never does."""
    reached = {}
    for run in runs:
        at, values = points(run.curve, RETURN).T
        frames = frames_until(at, values, level)
        reached[run.seed] = float(run.curve[-1]["frames"]) if math.isnan(frames) else frames
    return reached


def _curve_table(
    means: Mapping[str, Sequence[Array]],
    runs: Mapping[str, Sequence[Run]],
    reached: Mapping[str, Mapping[int, float]],
) -> str:
    """Return the table of the curves of a world: returns after parts of the training, and frames up to the guide."""
    table = []
    for label, (frames, mean, low, high) in means.items():
        line: dict[str, Any] = {"label": label, "runs": len(runs[label])}
        for fraction in FRACTIONS:
            if len(frames):
                at = int(np.abs(frames - fraction * frames[-1]).argmin())
                ends = (low[at], high[at]) if len(runs[label]) > 1 else (np.nan, np.nan)
                line[str(fraction)] = Estimate(mean[at], *ends).cell(".1f")
        table.append(line | {"reached": estimate(list(reached[label].values())).cell(",.0f")})
    columns = {"label": ("method", ""), "runs": ("runs", "d")}
    columns |= {
        str(f): (f"return after {text} of the frames (95 %)", "") for f, text in FRACTIONS.items()
    }
    columns |= {"reached": ("frames up to the guide (95 %)", "")}
    return markdown_table(table, columns)


def _paper_table(table: Sequence[Row]) -> str:
    """Return the table of COIL and PPO next to the paper."""
    by_label = {line["label"]: line for line in table}
    rows: list[dict[str, Any]] = [{"source": "paper, best", **PAPER_RETURNS}]
    for key in ("best", "final"):
        ours = {
            label: by_label[label][key].mean if label in by_label else None
            for label in PAPER_RETURNS
        }
        rows.append({"source": f"ours, {key}"} | ours)
    for row in rows:
        coil, ppo = row["coil"], row["ppo"]
        row["ratio"] = coil / ppo - 1 if coil is not None and ppo is not None and ppo > 0 else None
    return markdown_table(
        rows,
        {
            "source": ("mean over runs", ""),
            "coil": ("COIL", ".1f"),
            "ppo": ("RL (PPO)", ".1f"),
            "ratio": ("COIL over RL", "+.1%"),
        },
    )


def _draw_returns(rows: Sequence[Row], table: Sequence[Row], against: str, path: Path) -> None:
    # One guide for all: guides with placebo advice would only stretch the axis.
    guide = next(
        (
            line["guide"]
            for line in table
            if line["label"] == against and math.isfinite(line["guide"])
        ),
        None,
    )
    panels = {
        key: [
            Interval(
                line["label"],
                line[key].mean,
                line[key].low,
                line[key].high,
                guide=guide,
                points=[row[key] for row in rows if row["label"] == line["label"]]
                if line["runs"] > 1
                else [],
            )
            for line in table
        ]
        for key in ("best", "final")
    }
    title = "Table 4: the return of the trained policies"
    draw_intervals(panels, path, measure="return (mean of the runs)", title=title)
