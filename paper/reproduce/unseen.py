"""Table 5 of the paper: every policy on unseen tracks."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from coil_paper.reproduce import pages
from coil_paper.reproduce.ratio import EARNED, HEADING, SPEC, earned, relative
from coil_paper.reproduce.result import NO_RUNS, PAGES, Runs, WorldsResult
from coil_rl.report import (
    GUIDE,
    TERM,
    Comparison,
    Group,
    Run,
    cases_table,
    compare,
    draw_intervals,
    driver_intervals,
    markdown_table,
    paired,
    with_cells,
    write_csv,
)

Row = Mapping[str, Any]

ACTIONS = ("sampled", "deterministic")
PAPER_UNSEEN = PAGES["table_5"]["paper"]
MEASURE_COLUMNS = {
    "lap_time": ("lap (s)", ".2f"),
    "smoothness": ("smoothness", ".3f"),
    "reward": ("reward", ".1f"),
}


class Table5(WorldsResult):
    """Lap time, smoothness, reward and crashes of each policy on unseen tracks."""

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        parts, episodes = ["## Table 5: unseen tracks"], list[Row]()
        worlds: dict[str, dict[str, Comparison]] = {}
        for world, experiments in self.worlds.items():
            of_world = list(chain.from_iterable(runs[experiment] for experiment in experiments))
            for run in of_world:
                episodes += _episodes(run, world)
            compared = {actions: self._compare(of_world, actions) for actions in ACTIONS}
            worlds[world] = compared
            rows = {actions: self._rows(compared[actions]) for actions in ACTIONS}
            parts += pages.world_heading(world)
            if not world:
                parts.append(_paper_table(rows))
                _draw(compared, stem.with_suffix(".png"))
            for actions in ACTIONS:
                table = self._policy_table(rows[actions])
                parts += [f"**{actions.capitalize()} actions**", table]
                if not world:
                    groups = list(map(earned, compared[actions].groups))
                    parts.append(str(cases_table(groups, f"{stem.name}.csv")))
        write_csv(episodes, stem.with_suffix(".csv"))
        notes = PAGES["table_5"]["notes"].format(against=self.against)
        return "\n\n".join([*parts, notes, _claims(worlds)])

    def _compare(self, runs: Sequence[Run], actions: str) -> Comparison:
        """Return the guide of `against`, and the agents by rank, see `relative`.

        Agents that have only deterministic actions are always included.
        """
        agents: dict[str, Group] = {}
        compared, deterministic = (
            relative(compare(runs, kind)) for kind in (actions, "deterministic")
        )
        for group in (*compared.agents, *deterministic.agents):
            if not group.advice:
                agents.setdefault(group.name, group)
        own = agents[self.against].guide if self.against in agents else None
        guide = replace(own or compared.guides[0], name=GUIDE)
        ranked = sorted(agents.values(), key=lambda group: group.rank)
        return Comparison((guide,), tuple(replace(agent, guide=guide) for agent in ranked))

    def _rows(self, comparison: Comparison) -> list[dict[str, Any]]:
        """Return the measures of each policy, compared with `against` and with the guide."""
        rows = with_cells(comparison.table(self.against), SPEC)
        over_guide = [row["better"] for row in comparison.table(GUIDE)]
        return [
            row | {"over_guide": better, "reward": row[EARNED]}
            for row, better in zip(rows, over_guide, strict=True)
        ]

    def _policy_table(self, rows: Sequence[Row]) -> str:
        """Return the table of all policies; the terms of the reward are its last columns."""
        columns = {
            "driver": ("driver", ""),
            "seeds": ("seeds", ""),
            "completed": ("completed", ".0%"),
            "crashes": ("seeds with a crash (95 %)", ""),
            "reward cell": (f"{HEADING} (95 %)", ""),
            "difference cell": (f"difference to {self.against} (95 %)", ""),
            "better": (f"better than {self.against}", ".0%"),
            "over_guide": ("better than the guide", ".0%"),
            **MEASURE_COLUMNS,
        }
        for key in chain.from_iterable(rows):
            if key.startswith(TERM):
                columns[key] = (key.removeprefix(TERM), ".1f")
        return markdown_table(rows, columns)


def _episodes(run: Run, world: str) -> list[Row]:
    """Return the episodes of the evaluation of a run, as rows of the CSV file."""
    about = {"world": world, "label": run.label, "seed": run.seed}
    return [about | row for row in run.evaluation.map(_rounded).to_dict("records")]


def _rounded(value: object) -> object:
    """Round a number to six digits, which are enough and make the file half as large."""
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _draw(compared: Mapping[str, Comparison], path: Path) -> None:
    """Draw the scores of the agents, a panel for each kind of actions."""
    panels = {f"{kind} actions": driver_intervals(compared[kind].agents) for kind in ACTIONS}
    draw_intervals(panels, path, measure=f"{HEADING} (mean)", title="Table 5: unseen tracks")


def _claims(worlds: Mapping[str, Mapping[str, Comparison]]) -> str:
    """Return the verdicts in all worlds; in variants of the main world only those on the reward.

    Args:
        worlds: by world, for each kind of actions, the compared policies.
    """
    rows: list[dict[str, Any]] = []
    for world, by_actions in worlds.items():
        for claim, measure, policy, other, sign in PAGES["table_5"]["claims"]:
            if world and measure != "reward":
                continue
            cells = {}
            for actions, comparison in by_actions.items():
                by_name = {group.name: group for group in comparison.groups}
                if policy in by_name and other in by_name:
                    cells[actions] = _verdict(by_name[policy], by_name[other], measure, sign)
            if cells:
                paper = _paper_difference(measure, policy, other)
                rows.append({"world": world, "claim": claim, "paper": paper} | cells)
    rows.append(_claim_on_crashes(worlds[""]))
    headings = {"paper": "paper"}
    for actions in ACTIONS:
        headings[actions] = f"ours, {actions} actions (95 %)"
    return pages.claims_section(rows, headings)


def _verdict(group: Group, other: Group, measure: str, sign: int) -> pages.Claim | None:
    """Return the claim that a policy has more of a measure than another one, or less for sign -1.

    The result is None if the policies cannot be compared.
    """
    pairs = paired(group, other, measure)
    if pairs is None:
        return None
    spec = SPEC if measure == "reward" else MEASURE_COLUMNS[measure][1]
    return pages.Claim(pairs.difference, f"+{spec}", sign)


def _claim_on_crashes(by_actions: Mapping[str, Comparison]) -> dict[str, Any]:
    """Return the verdict on the claim that no policy of the paper crashes."""
    claim: dict[str, Any] = {"claim": "Nobody crashes", "paper": "0%"}
    for actions, comparison in by_actions.items():
        groups = [group for group in comparison.groups if group.name in PAPER_UNSEEN]
        details = ", ".join(f"{group.name} {group.crashes}" for group in groups)
        crashed = any(group.means()["crashed"] for group in groups)
        claim[actions] = pages.certain_verdict(not crashed, details)
    return claim


def _paper_table(rows: Mapping[str, Sequence[Row]]) -> str:
    """Return the table of the paper's policies next to the paper.

    Args:
        rows: by actions, the measures of each policy.
    """
    table: list[dict[str, Any]] = []
    for policy, paper in PAPER_UNSEEN.items():
        learned = policy in ("ppo", "coil")  # the others always act deterministically
        for actions in ACTIONS if learned else ACTIONS[:1]:
            by_name = {row["driver"]: row for row in rows[actions]}
            if policy not in by_name:
                continue
            line = {**by_name[policy], **{f"paper {name}": value for name, value in paper.items()}}
            line["actions"] = actions if learned else "the same"
            line["ratio"] = line["reward"] / by_name[GUIDE]["reward"]
            line["paper ratio"] = paper["reward"] / PAPER_UNSEEN[GUIDE]["reward"]
            table.append(line | {"paper crashed": 0.0})
    columns = {"driver": ("driver", ""), "actions": ("actions", "")}
    ratio = {"ratio": ("reward / guide's", ".3f"), "crashed": ("crashed", ".0%")}
    for key, (heading, spec) in {**MEASURE_COLUMNS, **ratio}.items():
        columns |= {key: (heading, spec), f"paper {key}": ("paper", spec)}
    return markdown_table(table, columns)


def _paper_difference(measure: str, policy: str, other: str) -> str | None:
    """Return the paper's difference between two policies; None if it has not both."""
    if policy not in PAPER_UNSEEN or other not in PAPER_UNSEEN:
        return None
    difference = PAPER_UNSEEN[policy][measure] - PAPER_UNSEEN[other][measure]
    if measure == "reward":
        return f"{difference / PAPER_UNSEEN[GUIDE][measure]:+{SPEC}}"
    return f"{difference:+{MEASURE_COLUMNS[measure][1]}}"
