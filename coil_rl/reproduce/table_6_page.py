"""The page of tables 6 and 7: a row a driver in both, and what held up of what the paper says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from coil_rl.report import markdown_table
from coil_rl.report.statistics import stratified_bootstrap
from coil_rl.reproduce.table_6_measures import mean
from coil_rl.reproduce.verdict import FAILED, HEADING, HELD, verdict

PRINTED = ("smoothness", "lap_time")
PAPER = {"guide": (0.265, 43.67), "oil": (0.104, 43.32), "ppo": (0.102, 40.14), "coil": (0.082, 39.53)}
REMARKS = {
    "guide": "sways, stays central",
    "oil": "smoother, less central",
    "ppo": "nearer the boundary",
    "coil": "cuts corners most",
}
SPECS = {"smoothness": ".3f", "lap_time": ".2f", "off_centre": ".3f", "clearance": ".3f", "corner_cut": ".3f"}

TABLE_6 = {
    "method": ("method", ""),
    "seeds": ("seeds", "d"),
    "drives": ("drives", "d"),
    "laps": ("laps", "d"),
    "crashes": ("crashes", "d"),
    "smoothness": ("smoothness", SPECS["smoothness"]),
    "paper_smoothness": ("paper", SPECS["smoothness"]),
    "lap_time": ("lap (s)", SPECS["lap_time"]),
    "paper_lap_time": ("paper (s)", SPECS["lap_time"]),
}
TABLE_7 = {
    "method": ("method", ""),
    "off_centre": ("from the centre (m)", SPECS["off_centre"]),
    "clearance": ("smallest clearance (m)", SPECS["clearance"]),
    "corner_cut": ("way / centre line", SPECS["corner_cut"]),
    "remark": ("paper", ""),
}
# What the paper says: a measure of which driver, beside whose, and whether more of it or less.
CLAIMS = (
    ("PPO steers more smoothly than the guide", "smoothness", "ppo", "guide", -1),
    ("COIL steers more smoothly than its guide", "smoothness", "coil", "guide", -1),
    ("COIL steers more smoothly than PPO", "smoothness", "coil", "ppo", -1),
    ("PPO's laps take less time than the guide's", "lap_time", "ppo", "guide", -1),
    ("COIL's laps take less time than PPO's", "lap_time", "coil", "ppo", -1),
    ("OIL steers more smoothly than the guide", "smoothness", "oil", "guide", -1),
    ("OIL is less central than the guide", "off_centre", "oil", "guide", 1),
    ("PPO drives nearer to the boundary than the guide", "clearance", "ppo", "guide", -1),
    ("COIL cuts corners more than PPO", "corner_cut", "coil", "ppo", -1),
)

NOTES = """
smoothness: mean of |a - weighted mean of the last 20 actions|, a the steering that the robot was told, as a fraction of
{max_steering:g} degrees. laps: from the start back to there, by odometry, and their mean time. crashes and what
follows need to know where the cones stood, which a recording notes as `track`: a robot crashed if its outline touched
a cone or its middle came to the line between two. The paper's robot drove on another track, so that its lap times
compare among themselves only. Each drive is a row of the CSV."""
OF_SEEDS = """
Differences are of the same seed, each the mean over its drives, of clearance the least; seeds: how many of them, for
who crashed in the first lap of every drive is compared by clearance alone. Intervals: percentile bootstrap of seeds,
{resamples} resamples; a single seed has none, and leaves open what others would do."""

Row = Mapping[str, Any]


def page(rows: Sequence[Row], where: str, max_steering: float, resamples: int, seed: int) -> str:
    """The page, Markdown.

    Args:
        rows: of the drives.
        where: what to add to headings, such as " (simulated)".
        max_steering: degrees of an action of 1.
        resamples: of the bootstrap.
        seed: of the bootstrap.
    """
    of_methods: dict[str, dict[str | None, list[Row]]] = {}
    for row in rows:
        of_methods.setdefault(row["method"], {}).setdefault(row["seed"], []).append(row)
    table = [_of_method(name, by_seed) for name, by_seed in of_methods.items()]
    parts = [f"## Table 6: the robot{where}", markdown_table(table, TABLE_6)]
    parts += [f"### Table 7, measured{where}", markdown_table(table, TABLE_7)]
    notes = NOTES.format(max_steering=max_steering).strip()
    means = {name: {seed: mean(drives) for seed, drives in of.items()} for name, of in of_methods.items()}
    if claims := [line for claim in CLAIMS if (line := _claim(means, claim, resamples, seed))]:
        claims.append(_crashes({line["method"]: line for line in table if line["method"] in PAPER}))
        columns = {"claim": ("the paper says", ""), "paper": ("paper", ""), "seeds": ("seeds", "")}
        held_up = markdown_table(claims, columns | {"ours": ("ours (95 %)", "")})
        return "\n\n".join([*parts, notes + OF_SEEDS.format(resamples=resamples), HEADING, held_up])
    return "\n\n".join([*parts, notes])


def _of_method(name: str, by_seed: Mapping[str | None, Sequence[Row]]) -> dict[str, Any]:
    """A method's row of both tables."""
    smooth, lap = PAPER.get(name, (None, None))
    return mean([row for drives in by_seed.values() for row in drives]) | {
        "method": name, "seeds": None if None in by_seed else len(by_seed), "paper_smoothness": smooth,
        "paper_lap_time": lap, "remark": REMARKS.get(name),
    }  # fmt: skip


def _claim(
    means: Mapping[str, Mapping[str | None, Row]], of: tuple[str, str, str, str, int], resamples: int, seed: int
) -> dict[str, Any] | None:
    """A row of what held up; None if one of the two does not drive, or they have no seed in common."""
    claim, measure, ours, theirs, sign = of
    if ours not in means or theirs not in means:
        return None
    # Who has no seed, as the guide, drives alike beside all of them.
    one = means[theirs].get(None)
    beside = [(row, means[theirs].get(number, one)) for number, row in means[ours].items()]
    pairs = [(row, other) for row, other in beside if other is not None]
    if not pairs:
        return None
    # Who has not come around has not steered through every turn.
    around = [pair for pair in pairs if measure == "clearance" or all(row["laps"] for row in pair)]
    found = np.array([row[measure] - other[measure] for row, other in around])
    known = found[np.isfinite(found)]
    line: dict[str, Any] = {"claim": claim, "seeds": f"{len(known)} of {len(pairs)}", "paper": None, "ours": None}
    if measure in PRINTED:
        place = PRINTED.index(measure)
        line["paper"] = f"{PAPER[ours][place] - PAPER[theirs][place]:+{SPECS[measure]}}"
    if len(known):
        ends = stratified_bootstrap(known[:, None], np.mean, resamples=resamples, seed=seed)
        line["ours"] = verdict(float(known.mean()), *ends, f"+{SPECS[measure]}", sign)
    return line


def _crashes(table: Mapping[str, Row]) -> dict[str, Any]:
    known = {name: row["crashes"] for name, row in table.items() if row["crashes"] is not None}
    said = ", ".join(f"{name} {crashes} of {table[name]['drives']} drives" for name, crashes in known.items())
    word = FAILED if any(known.values()) else HELD
    return {"claim": "Nobody crashes", "paper": "0", "ours": f"**{word}**: {said}" if known else None}
