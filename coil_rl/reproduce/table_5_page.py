"""The page of table 5: tables of drivers and of tracks, and what held up of what the paper says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from coil_rl.report import markdown_table
from coil_rl.report.comparison import Group, Paired, paired
from coil_rl.report.runs import GUIDE
from coil_rl.reproduce.verdict import FAILED, HEADING, HELD, verdict, with_interval

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
        pairs: Paired | None = row.get(against)
        over_guide: Paired | None = row.get(GUIDE)
        cells = {key: with_interval(row[key], row[f"{key}_low"], row[f"{key}_high"]) for key in ("reward", "iqm")}
        table.append({**row, **{f"{key} cell": cell for key, cell in cells.items()}} | {
            "difference": with_interval(*pairs.difference, "+.1f") if pairs else None,
            "better": pairs.better[0] if pairs else None, "over_guide": over_guide.better[0] if over_guide else None,
        })  # fmt: skip
    return markdown_table(table, {
        "driver": ("driver", ""), "seeds": ("seeds", ""), "completed": ("completed", ".0%"),
        "crashed": ("crashed", ".0%"), "lap_time": ("lap (s)", ".2f"), "smoothness": ("smoothness", ".3f"),
        "reward cell": ("reward: mean (95 %)", ""), "iqm cell": ("reward: IQM (95 %)", ""),
        "difference": (f"reward - {against}'s (95 %)", ""), "better": (f"better than {against}", ".0%"),
        "over_guide": ("better than the guide", ".0%"),
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


def held_up(worlds: Mapping[str, Mapping[str, Sequence[Group]]], resamples: int, seed: int) -> str:
    """A table of what the paper says, and whether it held up; in worlds besides the paper's only who earns more.

    Args:
        worlds: by name, "" for the paper's, the drivers by how they acted.
        resamples: of the bootstrap.
        seed: of the bootstrap.
    """
    rows: list[dict[str, Any]] = []
    for world, found in worlds.items():
        for claim, measure, label, other, sign in CLAIMS:
            cells = {}
            for actions, groups in found.items():
                named = {group.name: group for group in groups}
                if label in named and other in named and (measure == "reward" or not world):
                    pairs = paired(named[label], named[other], measure, resamples, seed)
                    cells[actions] = verdict(*pairs.difference, f"+{SPECS[measure]}", sign) if pairs else None
            if cells:
                said = f"{claim}, {world}" if world else claim
                rows.append({"claim": said, "paper": _difference(measure, label, other)} | cells)
    crashed = {
        actions: {group.name: group.means()["crashed"] for group in groups if group.name in PAPER}
        for actions, groups in worlds[""].items()
    }
    rows.append({"claim": "Nobody crashes", "paper": "0%"} | {
        actions: f"**{FAILED if any(shares.values()) else HELD}**: "
        + ", ".join(f"{name} {share:.0%}" for name, share in shares.items())
        for actions, shares in crashed.items()
    })  # fmt: skip
    columns = {"claim": ("the paper says", ""), "paper": ("paper", "")}
    columns |= {actions: (f"ours, {actions} actions (95 %)", "") for actions in worlds[""]}
    return f"{HEADING}\n\n{markdown_table(rows, columns)}"


def _difference(measure: str, label: str, other: str) -> str | None:
    """The paper's; None where it has not both."""
    if label not in PAPER or other not in PAPER:
        return None
    place = SHOWN.index(measure)
    return f"{PAPER[label][place] - PAPER[other][place]:+{SPECS[measure]}}"
