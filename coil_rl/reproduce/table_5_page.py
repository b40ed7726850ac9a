"""The page of table 5: tables of drivers and of tracks, and what held up of what the paper says."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from coil_rl.report import markdown_table
from coil_rl.report.comparison import Group
from coil_rl.report.paired import paired
from coil_rl.report.runs import GUIDE
from coil_rl.reproduce.verdict import interval, verdict

# Lap time s, smoothness and reward, each a mean over three unseen tracks; nobody crashed.
PAPER = {
    "guide": (48.81, 0.121, 609.4),
    "oil": (48.82, 0.061, 620.8),
    "ppo": (48.58, 0.557, 614.5),
    "coil": (48.48, 0.606, 632.9),
}
SHOWN = ("lap_time", "smoothness", "reward")
SPECS = {"lap_time": ".2f", "smoothness": ".3f", "reward": ".1f"}
IN_ONE_TABLE = 8  # tracks

# What the paper says, a measure of which driver, beside whose, and whether more of it or less.
CLAIMS = (
    ("COIL earns more than its guide", "reward", "coil", "guide", 1),
    ("COIL earns more than PPO", "reward", "coil", "ppo", 1),
    ("COIL earns more than imitation (OIL)", "reward", "coil", "oil", 1),
    ("PPO earns more than the guide", "reward", "ppo", "guide", 1),
    ("COIL's laps take less time than PPO's", "lap_time", "coil", "ppo", -1),
    ("COIL steers less smoothly than its guide", "smoothness", "coil", "guide", 1),
    ("COIL earns more with its guide's advice than with another car's", "reward", "coil", "coil_shuffled", 1),
)


def beside_the_paper(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """Our numbers and the paper's of the drivers that the paper has.

    Args:
        rows: of the drivers, by how they acted.
    """
    table: list[dict[str, Any]] = []
    for driver, paper in PAPER.items():
        for actions, of_kind in rows.items():
            found = {row["driver"]: row for row in of_kind}
            if driver in found and (driver in ("ppo", "coil") or not any(row["driver"] == driver for row in table)):
                row = found[driver]
                line: dict[str, Any] = {"driver": driver}
                line["actions"] = actions if driver in ("ppo", "coil") else "the same"
                line |= {key: row[key] for key in SHOWN}
                line |= {f"{key} paper": value for key, value in zip(SHOWN, paper, strict=True)}
                line |= {"ratio": row["reward"] / found[GUIDE]["reward"], "ratio paper": paper[2] / PAPER[GUIDE][2]}
                table.append(line | {"crashed": row["crashed"], "crashed paper": 0.0})
    headings = {"lap_time": "lap (s)", "smoothness": "smoothness", "reward": "reward"}
    columns = {"driver": ("driver", ""), "actions": ("actions", "")}
    for key, heading in headings.items():
        columns |= {key: (heading, SPECS[key]), f"{key} paper": ("paper", SPECS[key])}
    columns |= {"ratio": ("reward / guide's", ".3f"), "ratio paper": ("paper", ".3f")}
    columns |= {"crashed": ("crashed", ".0%"), "crashed paper": ("paper", ".0%")}
    return markdown_table(table, columns)


def drivers(rows: Sequence[Mapping[str, Any]], against: str) -> str:
    """One row a driver, what it completed first.

    Args:
        rows: of the drivers.
        against: label that the others are compared with.
    """
    table = []
    for row in rows:
        line = {**row, "reward_interval": interval(row["reward_low"], row["reward_high"])}
        line |= {"iqm_interval": interval(row["iqm_low"], row["iqm_high"])}
        for name in (against, GUIDE):
            pairs = row.get(name)
            line |= {f"{name}_difference": None, f"{name}_interval": None, f"{name}_better": None}
            if pairs is not None:
                difference, low, high = pairs.difference
                line |= {f"{name}_difference": difference, f"{name}_interval": interval(low, high, "+.1f")}
                line |= {f"{name}_better": pairs.better[0]}
        table.append(line)
    return markdown_table(table, {
        "driver": ("driver", ""), "seeds": ("seeds", ""), "completed": ("completed", ".0%"),
        "crashed": ("crashed", ".0%"), "lap_time": ("lap (s)", ".2f"), "smoothness": ("smoothness", ".3f"),
        "reward": ("reward (mean)", ".1f"), "reward_interval": ("95 %", ""), "iqm": ("IQM", ".1f"),
        "iqm_interval": ("95 %", ""), f"{against}_difference": (f"reward - {against}'s", "+.1f"),
        f"{against}_interval": ("95 %", ""), f"{against}_better": (f"better than {against}", ".0%"),
        f"{GUIDE}_better": ("better than the guide", ".0%"), "needs_guide": ("guide at test time", ""),
    })  # fmt: skip


def tracks(groups: Sequence[Group], name: str) -> str:
    """The mean reward of each driver on each track, and how much of it was completed where not all was.

    Args:
        groups: the drivers.
        name: of the file that has all numbers.
    """
    names = groups[0].tracks
    if len(names) > IN_ONE_TABLE:
        return f"The numbers of each of the {len(names)} tracks are in {name}.csv."
    rows = []
    for group in groups:
        row: dict[str, Any] = {"driver": group.name}
        for place, track in enumerate(names):
            means = group.means(place)
            row[track] = f"{means['reward']:.1f}"
            if means["completed"] < 1:
                row[track] += f" ({means['completed']:.0%} completed)"
        rows.append(row)
    return markdown_table(rows, {"driver": ("mean reward", "")} | {track: (track, "") for track in names})


def verdicts(found: Mapping[str, Sequence[Group]], world: str, resamples: int, seed: int) -> list[str]:
    """What held up of what the paper says, a line for each claim and way to act.

    Args:
        found: the drivers, by how they acted.
        world: its name; empty for the paper's.
        resamples: of the bootstrap.
        seed: of the bootstrap.
    """
    lines = []
    for claim, measure, label, other, sign in CLAIMS:
        for actions, groups in found.items():
            named = {group.name: group for group in groups}
            pairs = label in named and other in named and paired(named[label], named[other], measure, resamples, seed)
            if pairs:
                difference, low, high = pairs.difference
                spec = f"+{SPECS[measure]}"
                said = f"{difference:{spec}} (95 % {interval(low, high, spec) or 'unknown'}); paper "
                said += _paper(measure, label, other, spec)
                where = ", ".join(filter(None, (f"{actions} actions", world)))
                lines.append(verdict(f"{claim} ({where})", *((low, high) if sign > 0 else (-high, -low)), said))
    if not world:
        shares = {group.name: group.means()["crashed"] for groups in found.values() for group in reversed(groups)}
        named_shares = ", ".join(f"{name} {shares[name]:.0%}" for name in PAPER if name in shares)
        worst = max((shares[name] for name in PAPER if name in shares), default=math.nan)
        lines.append(verdict("Nobody crashes", *((1, 1) if worst == 0 else (-1, -1)), f"{named_shares}; paper 0%"))
    return lines


def _paper(measure: str, label: str, other: str, spec: str) -> str:
    if label not in PAPER or other not in PAPER:
        return "has no such run"
    place = SHOWN.index(measure)
    return f"{PAPER[label][place] - PAPER[other][place]:{spec}}"
