"""How often coil-compare is right: what it recommends, and what whole trainings gave.

    python -m benchmarks.guide_benchmark.advised docs/guide_benchmark/rows.csv outputs/advised

It runs coil-compare for each task and guide in a table of rows, with the frames of those rows, and
goes on where it was stopped. What a recommendation is worth is read off the table: the end of the
recommended method, or the return of the guide. The regret is the distance to the best of all
methods with that guide, of plain PPO and of the guide itself, in percent of the distance from
random actions to that best.
"""

import argparse
import csv
import math
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.guide_benchmark import picture
from benchmarks.guide_benchmark.rows import read_rows
from benchmarks.promise import ALONE, PPO
from coil_rl.comparison.arms import ANCHORED, GUIDE, OPPOSITE, TUNE
from coil_rl.comparison.compare import FOUND, TABLE
from coil_rl.comparison.entry import IDLE
from coil_rl.files import write_text
from coil_rl.report import markdown_table, write_csv

Row = Mapping[str, Any]
DETUNED = "detuned"
ARMS = tuple(arm for arm in picture.ARMS if arm != "shuffled")  # one placebo is enough
RULES = (GUIDE, PPO, ANCHORED)  # that say the same everywhere, to compare with
UNTRAINED = (GUIDE, OPPOSITE, TUNE, *IDLE)  # in place of these a training is judged by its end
RIGHT = (1.0, 5.0, 20.0)  # percent of regret
OWN = Path(__file__).parent / "conf" / "task"  # tasks of other packages
COLUMNS = {
    "task": ("task", ""),
    "arm": ("guide", ""),
    "use": ("recommended", ""),
    "value": ("whole training", ".1f"),
    "best": ("best", ""),
    "best_value": ("its end", ".1f"),
    "regret": ("regret (%)", ".1f"),
    **{f"regret_{rule}": (f"always {rule}", ".1f") for rule in RULES},
}


def ends(rows: Sequence[Row], task: str, arm: str) -> dict[str, float]:
    """Return what whole trainings with a guide gave, by method; plain PPO and the guide too."""
    # The comparisons have no numbers to tune.
    own = [row for row in rows if row["task"] == task and row["method"] != TUNE]
    guides = [float(row["guide"]) for row in own if row["arm"] == arm]
    kept = [row for row in own if row["arm"] == arm or (row["method"], row["arm"]) == (PPO, ALONE)]
    found = {row["method"]: float(row["end"]) for row in kept}
    return found | {GUIDE: float(np.mean(guides))}


def words(task: str, arm: str, folder: Path, frames: int) -> list[str]:
    """Return the arguments of coil-compare."""
    file = f"{arm}/{task.partition('_noisy')[0]}" if arm == DETUNED else arm
    searched = ["hydra.searchpath=[pkg://benchmarks.guide_benchmark.conf]"]
    own = searched if (OWN / f"{task}.yaml").exists() else []
    return [*own, f"+task={task}", f"+arm={file}", f"budget.frames={frames}", f"folder={folder}"]


def judged(rows: Sequence[Row], task: str, arm: str, folder: Path) -> dict[str, Any]:
    """Return the row of a comparison: what it said, and what that is worth."""
    values = ends(rows, task, arm)
    said = FOUND.need(folder)
    use = said["use"] if said["use"] in UNTRAINED else said["train"] or GUIDE
    # The benchmark has no row for the opposite of a guide, nor for each method of coil-compare.
    value = values[use] if use in values else _measured(folder, use)
    if use == OPPOSITE:
        values = values | {OPPOSITE: value}
    best = max(values, key=lambda name: values[name])
    random = next(float(row["random"]) for row in rows if row["task"] == task)

    def regret(end: float) -> float:
        return 100 * (values[best] - end) / (values[best] - random)

    return {
        "task": task,
        "arm": arm,
        "use": use if said["use"] == use else f"{said['use']}; to train: {use}",
        "value": value,
        "best": best,
        "best_value": values[best],
        "regret": max(regret(value), 0.0),
        "in_table": use in values,
        **{f"regret_{rule}": regret(values.get(rule, math.nan)) for rule in RULES},
    }


def _measured(folder: Path, name: str) -> float:
    """Return the mean return of a policy in a comparison itself."""
    with (folder / TABLE).open(newline="") as file:
        return next(float(row["return"]) for row in csv.DictReader(file) if row["policy"] == name)


def page(found: Sequence[Mapping[str, Any]]) -> str:
    """Return the page of all comparisons."""
    titles = {"regret": "coil-compare"} | {f"regret_{rule}": f"always {rule}" for rule in RULES}
    summary = []
    for name, title in titles.items():
        regrets = np.array([row[name] for row in found])
        regrets = regrets[~np.isnan(regrets)]  # a table may lack the row of a method
        shares = [f"{np.mean(regrets <= share):.0%} within {share:.0f} %" for share in RIGHT]
        mean = f"mean regret {regrets.mean():.1f} %, {', '.join(shares)}" if len(regrets) else "-"
        summary.append(f"- **{title}**, of {len(regrets)}: {mean}.")
    lines = [
        "# What coil-compare recommends, and what whole trainings gave",
        f"{len(found)} comparisons.",
        "\n".join(summary),
        markdown_table(found, COLUMNS),
    ]
    unknown = [f"{row['task']}, {row['arm']}" for row in found if not row["in_table"]]
    if unknown:
        lines.append(
            "Not in the benchmark, so that its return after the comparison itself is taken: "
            f"{'; '.join(unknown)}."
        )
    return "\n\n".join(lines) + "\n"


def run(place: Path, arguments: Sequence[str]) -> None:
    """Run a comparison, unless it is finished; what it prints is in log.txt, beside its folder.

    Raises:
        ChildProcessError: if it fails.
    """
    if (place / FOUND.name).exists():
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    log = place.parent / "log.txt"
    command = [sys.executable, "-m", "coil_rl.comparison.program", *arguments]
    with log.open("a") as output:
        done = subprocess.run(command, stdout=output, stderr=output, check=False)
    if done.returncode:
        raise ChildProcessError(f"{place} failed; see {log}")


def main() -> None:
    """Run the comparisons that are missing, and write the page and the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", type=Path, help="table of the guide benchmark")
    parser.add_argument("folder", type=Path, help="of the comparisons")
    parser.add_argument("--arms", nargs="+", choices=picture.ARMS, default=ARMS, help="of guides")
    parser.add_argument("--tasks", nargs="+", help="all of the table by default")
    parser.add_argument("--minutes", type=float, default=2.0, help="of each comparison")
    parser.add_argument("--words", nargs="+", default=[], help="further ones of each comparison")
    given = parser.parse_args()
    try:
        rows = [row for row in read_rows(given.rows) if row["effort"] != "smoke"]
    except (OSError, ValueError, csv.Error) as error:
        parser.error(str(error))
    cases = sorted({(row["task"], row["arm"]) for row in rows if row["arm"] in given.arms})
    found = []
    for task, arm in tqdm(cases, unit="comparison"):
        if given.tasks is not None and task not in given.tasks:
            continue
        place = given.folder / f"{task}_{arm}"
        frames = max(round(float(row["frames"])) for row in rows if row["task"] == task)
        try:
            arguments = [f"minutes={given.minutes}", *words(task, arm, place, frames)]
            run(place, [*arguments, *given.words])
        except ChildProcessError as error:
            parser.error(str(error))
        found.append(judged(rows, task, arm, place))
    if not found:
        parser.error(f"{given.rows} has no rows of a whole training with these tasks and guides")
    write_csv(found, given.folder / "advised.csv")
    text = page(found)
    write_text(given.folder / "advised.md", text)
    print(text)


if __name__ == "__main__":
    main()
