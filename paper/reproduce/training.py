"""Table 4 and figure 22 of the paper: the return of the policies of a training run."""

import math
from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd

from coil_paper.reproduce import pages
from coil_paper.reproduce.result import NO_RUNS, PAGES, Runs, WorldsResult, runs_by_label
from coil_rl.ranges import Len, checked
from coil_rl.report import (
    GUIDE,
    RETURN,
    Estimate,
    Interval,
    Run,
    draw_intervals,
    draw_learning_curves,
    estimate,
    frames_until,
    guide_return,
    learning,
    markdown_table,
    mean_curve,
    points,
    wins,
    write_csv,
)

Row = Mapping[str, Any]

PAPER_RETURNS = PAGES["table_4"]["paper"]
FRACTIONS = {0.1: "a tenth", 0.25: "a quarter", 0.5: "half", 1.0: "all"}  # of the frames
POINT = ("frames", "mean", "low", "high")  # of a curve


class Table4(WorldsResult):
    """Return of the best and of the last policy of each method."""

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        rows = {world: _returns(names, runs) for world, names in self.worlds.items()}
        every_row = [{"world": world, **row} for world, each in rows.items() for row in each]
        write_csv(every_row, stem.with_suffix(".csv"))
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
        parts.append(PAGES["table_4"]["notes"].format(against=self.against))
        claims = self._claims(tables)
        if claims:
            parts.append(pages.claims_section(claims, {"paper": "paper", "ours": "ours (95 %)"}))
        return "\n\n".join(parts)

    def _table(self, rows: Sequence[Row]) -> list[dict[str, Any]]:
        """Return one row per label, the best first."""
        runs = pd.DataFrame(rows).set_index("seed")
        reference = runs["best"][runs["label"] == self.against]
        table = []
        for label, own in runs.groupby("label", sort=False):
            common = own.index.intersection(reference.index if label != self.against else [])
            ours, theirs = (best[common].to_numpy() for best in (own["best"], reference))
            line: dict[str, Any] = {"label": label, "runs": len(own), "guide": own["guide"].mean()}
            line["better"] = float(wins(ours, theirs).mean()) if len(common) else None
            numbers = {"best": own["best"], "final": own["final"], "difference": ours - theirs}
            for key, values in numbers.items():
                line[key] = estimate(values)
                line[f"{key} cell"] = line[key].cell("+.1f" if key == "difference" else ".1f")
            table.append(line)
        # The best first, a label without a number last.
        return sorted(table, key=lambda line: -np.nan_to_num(line["best"].mean, nan=-np.inf))

    def _claims(self, tables: Mapping[str, Sequence[Row]]) -> list[Row]:
        """Return the verdicts on the claim of the paper, which is about PPO, in all worlds."""
        claims: list[Row] = []
        paper = f"{PAPER_RETURNS['coil'] - PAPER_RETURNS['ppo']:+.1f}"
        claim = "COIL's best return is above PPO's"
        for world, table in tables.items():
            for line in table:
                if line["label"] == "coil" and self.against == "ppo":
                    ours = pages.Claim(line["difference"], "+.1f")
                    claims.append({"world": world, "claim": claim, "paper": paper, "ours": ours})
        return claims


def _returns(experiments: Sequence[str], runs: Runs) -> list[Row]:
    """Return the numbers of the evaluation curve of each run of some experiments."""
    own = chain.from_iterable(runs[experiment] for experiment in experiments)
    return [{"label": run.label, "seed": run.seed} | learning(run) for run in own if run.curve]


@checked
class Figure22(WorldsResult):
    """Learning curves of the runs with some labels.

    The return of the guide of the first label is drawn as a line. A label is drawn in every world
    that has runs of it. Variants of the main world have pictures of their own, `stem_2.png` and so
    on.

    Args:
        labels: of the runs to draw.
    """

    def __init__(
        self,
        experiments: Sequence[str],
        labels: Annotated[Sequence[str], Len(1)] = ("coil", "ppo"),
        worlds: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        super().__init__(experiments, worlds)
        self.labels = list(labels)

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        learned = {name: [run for run in runs[name] if run.curve] for name in self.experiments}
        runs_by_label(self.labels, learned)  # each has runs in some world
        parts, rows, claims = ["## Figure 22: learning curves"], list[Row](), list[Row]()
        for number, (world, experiments) in enumerate(self.worlds.items(), start=1):
            of_world = list(chain.from_iterable(learned[experiment] for experiment in experiments))
            by_label = {
                name: [run for run in of_world if run.label == name] for name in self.labels
            }
            curves = _Curves(world, {name: own for name, own in by_label.items() if own})
            picture = f"{stem.name}_{number}.png" if world else f"{stem.name}.png"
            curves.draw(stem.with_name(picture))
            parts += curves.page(picture)
            rows += curves.rows()
            claims += curves.claims()
        write_csv(rows, stem.with_suffix(".csv"))
        parts.append(PAGES["figure_22"]["notes"])
        if claims:
            parts.append(pages.claims_section(claims, {"ours": "ours (95 %)"}))
        return "\n\n".join(parts)


class _Curves:
    """The learning curves in one world.

    Args:
        world: its name, "" for the main world.
        runs: by label, at least one run of each.
    """

    def __init__(self, world: str, runs: Mapping[str, Sequence[Run]]) -> None:
        self.world, self.runs = world, runs
        self.means = {
            label: mean_curve([run.curve for run in of_label], RETURN)
            for label, of_label in runs.items()
        }
        self.guide = guide_return(next(iter(runs.values())))
        self.reached = {label: _frames_to(self.guide, of_label) for label, of_label in runs.items()}
        self.title = "Figure 22: the return of the trained policies"
        if world:
            self.title += f", {world}"

    def draw(self, path: Path) -> None:
        """Draw the curves."""
        curves = {label: [run.curve for run in of_label] for label, of_label in self.runs.items()}
        guides = {} if math.isnan(self.guide) else {GUIDE: self.guide}
        draw_learning_curves(curves, path, guides=guides, title=self.title)

    def rows(self) -> list[Row]:
        """Return the points of the mean curves."""
        rows: list[Row] = []
        for label, curve in self.means.items():
            about = {"world": self.world, "label": label}
            points_of_curve = zip(*curve, strict=True)
            rows += [about | dict(zip(POINT, each, strict=True)) for each in points_of_curve]
        return rows

    def page(self, picture: str) -> list[str]:
        """Return the parts of the page, given the file name of the picture.

        The picture of the main world is not among them, because the frame of all pages has it.
        """
        parts = pages.world_heading(self.world)
        if self.world:
            parts.append(f"![{self.title}]({picture})")
        parts.append(self._table())
        if not math.isnan(self.guide):
            parts.append(f"The guide alone earns {self.guide:.1f} in these cases.")
        return parts

    def _table(self) -> str:
        """Return the table: returns after parts of the training, and frames up to the guide."""
        table = []
        for label, (frames, mean, low, high) in self.means.items():
            count = len(self.runs[label])
            line: dict[str, Any] = {"label": label, "runs": count}
            for fraction in FRACTIONS:
                if len(frames):
                    at = int(np.abs(frames - fraction * frames[-1]).argmin())
                    ends = (low[at], high[at]) if count > 1 else (np.nan, np.nan)
                    line[str(fraction)] = Estimate(mean[at], *ends).cell(".1f")
            line["reached"] = estimate(list(self.reached[label].values())).cell(",.0f")
            table.append(line)
        columns = {"label": ("method", ""), "runs": ("runs", "d")}
        for fraction, text in FRACTIONS.items():
            columns[str(fraction)] = (f"return after {text} of the frames (95 %)", "")
        columns["reached"] = ("frames up to the guide (95 %)", "")
        return markdown_table(table, columns)

    def claims(self) -> list[Row]:
        """Return the verdicts on the curves, as rows of `claims_section`."""
        claims: list[Row] = []
        for claim, policy, other in PAGES["figure_22"]["claims"]:
            if policy not in self.runs or other not in self.runs:
                continue
            ours = self._above(policy, other) if claim == "above" else self._sooner(policy, other)
            text = PAGES["figure_22"]["texts"][claim].format(driver=policy, other=other)
            claims.append({"world": self.world, "claim": text, "ours": ours})
        return claims

    def _above(self, policy: str, other: str) -> str:
        """Return the verdict on the claim that one mean curve is above another one everywhere."""
        frames, mean, *_ = self.means[policy]
        _, others, *_ = self.means[other]
        above = (mean > others)[frames > 0]  # both begin untrained
        details = f"at {above.sum()} of {len(above)} points"
        return pages.certain_verdict(bool(above.all()), details)

    def _sooner(self, policy: str, other: str) -> pages.Claim:
        """Return the claim that a policy reaches its guide within fewer frames than another one."""
        ours, theirs = self.reached[policy], self.reached[other]
        seeds = sorted(ours.keys() & theirs.keys())
        more = [ours[seed] - theirs[seed] for seed in seeds]
        return pages.Claim(estimate(more), "+,.0f", -1)


def _frames_to(level: float, runs: Sequence[Run]) -> dict[int, float]:
    """Return by seed after how many frames a curve first reaches a level.

    If it never does, these are all frames of the run.
    """
    reached = {}
    for run in runs:
        at, values = points(run.curve, RETURN).T
        frames = frames_until(at, values, level)
        reached[run.seed] = float(run.curve[-1]["frames"]) if math.isnan(frames) else frames
    return reached


def _paper_table(table: Sequence[Row]) -> str:
    """Return the table of COIL and PPO next to the paper."""
    by_label = {line["label"]: line for line in table}
    rows: list[dict[str, Any]] = [{"source": "paper, best", **PAPER_RETURNS}]
    for key in ("best", "final"):
        means = {label: by_label[label][key].mean for label in PAPER_RETURNS if label in by_label}
        rows.append({"source": f"ours, {key}", **means})
    for row in rows:
        coil, ppo = row.get("coil"), row.get("ppo")
        row["ratio"] = coil / ppo - 1 if coil is not None and ppo is not None and ppo > 0 else None
    columns = {
        "source": ("mean over runs", ""),
        "coil": ("COIL", ".1f"),
        "ppo": ("RL (PPO)", ".1f"),
        "ratio": ("COIL over RL", "+.1%"),
    }
    return markdown_table(rows, columns)


def _draw_returns(rows: Sequence[Row], table: Sequence[Row], against: str, path: Path) -> None:
    """Draw the returns of the best and of the last policies, one row per label."""
    # One guide for all: guides with placebo advice would only stretch the axis.
    guides = [line["guide"] for line in table if line["label"] == against]
    guide = guides[0] if guides and math.isfinite(guides[0]) else None
    panels: dict[str, list[Interval]] = {"best": [], "final": []}
    for key, panel in panels.items():
        for line in table:
            label, value = line["label"], line[key]
            single = [row[key] for row in rows if row["label"] == label] if line["runs"] > 1 else []
            panel.append(
                Interval(label, value.mean, value.low, value.high, guide=guide, points=single)
            )
    title = "Table 4: the return of the trained policies"
    draw_intervals(panels, path, measure="return (mean of the runs)", title=title)
