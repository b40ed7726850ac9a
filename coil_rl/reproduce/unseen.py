"""Table 5 of the paper: every driver on unseen tracks."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from coil_rl.report import draw_intervals, driver_intervals, markdown_table, write_csv
from coil_rl.report.comparison import Comparison, Group, compare, paired
from coil_rl.report.page import cases_table, with_cells
from coil_rl.report.runs import GUIDE, TERM, Run
from coil_rl.reproduce import pages
from coil_rl.reproduce.result import NO_RUNS, PAGES, Runs, WorldsResult

Row = Mapping[str, Any]

ACTIONS = ("sampled", "deterministic")
PAPER_UNSEEN = PAGES["table_5"]["paper"]
MEASURE_COLUMNS = {
    "lap_time": ("lap (s)", ".2f"),
    "smoothness": ("smoothness", ".3f"),
    "reward": ("reward", ".1f"),
}


class Table5(WorldsResult):
    """Lap time, smoothness, reward and crashes of each driver on unseen tracks."""

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make the result, see `Result`."""
        parts, episodes, worlds = ["## Table 5: unseen tracks"], [], {}
        for world, experiments in self.worlds.items():
            of_world = [run for experiment in experiments for run in runs[experiment]]
            for run in of_world:
                about = {"world": world, "label": run.label, "seed": run.seed}
                # Six digits are enough, and half the size.
                rounded = run.evaluation.map(
                    lambda value: float(f"{value:.6g}") if isinstance(value, float) else value
                )
                episodes += [about | row for row in rounded.to_dict("records")]
            compared = worlds[world] = {
                actions: self._compare(of_world, actions) for actions in ACTIONS
            }
            rows = {actions: self._rows(compared[actions]) for actions in ACTIONS}
            parts += pages.world_heading(world)
            if not world:
                parts.append(_paper_table(rows))
                panels = {
                    f"{actions} actions": driver_intervals(compared[actions].agents)
                    for actions in ACTIONS
                }
                title, measure = "Table 5: unseen tracks", f"{compared[ACTIONS[0]].score[0]} (mean)"
                draw_intervals(panels, stem.with_suffix(".png"), measure=measure, title=title)
            for actions in ACTIONS:
                table = self._driver_table(rows[actions], compared[actions].score[0])
                parts += [f"**{actions.capitalize()} actions**", table]
                parts += (
                    [] if world else [cases_table(compared[actions].groups, f"{stem.name}.csv")]
                )
        write_csv(episodes, stem.with_suffix(".csv"))
        notes = PAGES["table_5"]["notes"].format(against=self.against)
        return "\n\n".join([*parts, notes, self._claims(worlds)])

    def _compare(self, runs: Sequence[Run], actions: str) -> Comparison:
        """Return the guide, and the agents by rank; agents with only deterministic actions are always included."""
        agents: dict[str, Group] = {}
        compared, deterministic = compare(runs, actions), compare(runs, "deterministic")
        for group in (*compared.agents, *deterministic.agents):
            if not group.advice:
                agents.setdefault(group.name, group)
        guide = (agents[self.against].guide if self.against in agents else None) or compared.guides[
            0
        ]
        guide = replace(guide, name=GUIDE)
        ranked = sorted(agents.values(), key=lambda group: group.rank)
        return Comparison((guide,), tuple(replace(agent, guide=guide) for agent in ranked))

    def _rows(self, comparison: Comparison) -> list[dict[str, Any]]:
        """Return the measures of each driver, and its comparison with `against` and with the guide."""
        rows = with_cells(comparison.table(self.against), comparison.score[1])
        over_guide = [row["better"] for row in comparison.table(GUIDE)]
        return [row | {"over_guide": better} for row, better in zip(rows, over_guide, strict=True)]

    def _driver_table(self, rows: Sequence[Row], score: str) -> str:
        terms = dict.fromkeys(key for row in rows for key in row if key.startswith(TERM))
        return markdown_table(
            rows,
            {
                "driver": ("driver", ""),
                "seeds": ("seeds", ""),
                "completed": ("completed", ".0%"),
                "crashes": ("seeds with a crash (95 %)", ""),
                "score cell": (f"{score} (95 %)", ""),
                "difference cell": (f"difference to {self.against} (95 %)", ""),
                "better": (f"better than {self.against}", ".0%"),
                "over_guide": ("better than the guide", ".0%"),
                **MEASURE_COLUMNS,
                **{key: (key.removeprefix(TERM), ".1f") for key in terms},
            },
        )

    def _claims(self, worlds: Mapping[str, Mapping[str, Comparison]]) -> str:
        """Return the verdicts in all worlds; in variants of the main world only those on the reward."""
        rows: list[dict[str, Any]] = []
        for world, by_actions in worlds.items():
            for claim, measure, driver, other, sign in PAGES["table_5"]["claims"]:
                cells = {}
                for actions, comparison in by_actions.items():
                    by_name = {group.name: group for group in comparison.groups}
                    if (
                        driver in by_name
                        and other in by_name
                        and (measure == "reward" or not world)
                    ):
                        in_score = measure == "reward"
                        pairs = paired(
                            by_name[driver], by_name[other], "score" if in_score else measure
                        )
                        spec = (
                            f"+{comparison.score[1] if in_score else MEASURE_COLUMNS[measure][1]}"
                        )
                        cells[actions] = (
                            pages.Claim(pairs.difference, spec, sign) if pairs else None
                        )
                if cells:
                    paper = _paper_difference(
                        measure, driver, other, by_actions[ACTIONS[0]].normalised
                    )
                    rows.append({"world": world, "claim": claim, "paper": paper} | cells)
        crashes: dict[str, str] = {"claim": "Nobody crashes", "paper": "0%"}
        for actions, comparison in worlds[""].items():
            drivers = [group for group in comparison.groups if group.name in PAPER_UNSEEN]
            details = ", ".join(f"{group.name} {group.crashes}" for group in drivers)
            crashes[actions] = pages.certain_verdict(
                not any(group.means()["crashed"] for group in drivers), details
            )
        headings = {"paper": "paper"} | {
            actions: f"ours, {actions} actions (95 %)" for actions in ACTIONS
        }
        return pages.claims_section([*rows, crashes], headings)


def _paper_table(rows: Mapping[str, Sequence[Row]]) -> str:
    """Return the table of the paper's drivers next to the paper, given the rows of the drivers by actions."""
    table: list[dict[str, Any]] = []
    for driver, paper in PAPER_UNSEEN.items():
        learned = driver in ("ppo", "coil")
        for actions in ACTIONS if learned else ACTIONS[:1]:
            by_name = {row["driver"]: row for row in rows[actions]}
            if row := by_name.get(driver):
                ratios = {
                    "ratio": row["reward"] / by_name[GUIDE]["reward"],
                    "paper ratio": paper["reward"] / PAPER_UNSEEN[GUIDE]["reward"],
                }
                values = {f"paper {measure}": value for measure, value in paper.items()} | ratios
                table.append(
                    {
                        **row,
                        **values,
                        "actions": actions if learned else "the same",
                        "paper crashed": 0.0,
                    }
                )
    columns = {"driver": ("driver", ""), "actions": ("actions", "")}
    ratio = {"ratio": ("reward / guide's", ".3f"), "crashed": ("crashed", ".0%")}
    for key, (heading, spec) in {**MEASURE_COLUMNS, **ratio}.items():
        columns |= {key: (heading, spec), f"paper {key}": ("paper", spec)}
    return markdown_table(table, columns)


def _paper_difference(measure: str, driver: str, other: str, relative: bool) -> str | None:
    if driver not in PAPER_UNSEEN or other not in PAPER_UNSEEN:
        return None
    difference = PAPER_UNSEEN[driver][measure] - PAPER_UNSEEN[other][measure]
    if measure == "reward" and relative:
        return f"{difference / PAPER_UNSEEN[GUIDE][measure]:+.3f}"
    return f"{difference:+{MEASURE_COLUMNS[measure][1]}}"
