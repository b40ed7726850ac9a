"""Command line of the guide benchmark: the pages and the table of finished runs.

    python -m benchmarks.guide_benchmark outputs/experiments/guide_benchmark

Each folder in it has the runs of one task. With `--add FILE` the rows join a table that exists; a
row of the same task, method, arm and configuration is replaced. The pages are then of the whole
table. Learning curves need the runs: a picture that exists stays. Without a folder the pages are
made again from the table.
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.guide_benchmark.pages import draw_curves, write_all, write_task
from benchmarks.guide_benchmark.rows import benchmark_rows, check_row, read_rows
from benchmarks.promise import runs_of, with_ppo
from coil_rl.errors import UserError
from coil_rl.report import write_csv
from coil_rl.report.runs import Run, failed_jobs

SAME = ("task", "method", "arm", "fingerprint")  # of two rows that replace each other


def added(file: Path, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a file, with others in place of their older forms or behind them.

    Args:
        file: a table of rows; it need not exist.

    Raises:
        ValueError: if a row is not valid.
    """
    for row in rows:
        check_row({name: "" if value is None else str(value) for name, value in row.items()})
    if not file.exists():
        return list(rows)
    known = read_rows(file)
    new = {tuple(row[name] for name in SAME) for row in rows}
    return [row for row in known if tuple(row[name] for name in SAME) not in new] + list(rows)


def main() -> None:
    """Write the pages and the table, and print the page that holds all tasks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "folder", type=Path, nargs="?", help="of the experiments, with a folder for each task"
    )
    parser.add_argument("--pages", type=Path, help="where to write; FOLDER/pages by default")
    parser.add_argument("--add", type=Path, help="table of rows that the new ones join")
    given = parser.parse_args()
    if given.folder is None and not (given.pages and given.add):
        parser.error("give the folder of the experiments, or --pages and --add with a table")
    if given.folder is not None and not given.folder.is_dir():
        parser.error(f"{given.folder} does not exist; give the folder of the experiments")
    pages = given.pages or given.folder / "pages"
    runs: dict[str, list[Run]] = {}
    try:
        if given.folder is not None:
            runs = with_ppo(given.folder, runs_of(given.folder, pages))
        found = [row for task in runs for row in benchmark_rows(task, runs[task])]
        table = added(given.add, found) if given.add else found
    except (ValueError, UserError, csv.Error) as error:
        parser.error(str(error))
    pages.mkdir(parents=True, exist_ok=True)
    for file in {pages / "rows.csv", given.add or pages / "rows.csv"}:
        write_csv(table, file)
    for task, own in runs.items():
        finished, refused = sum(run.finished for run in own), failed_jobs([given.folder / task])
        print(f"{task}: {finished} of {len(own) + refused} runs finished, {refused} were refused")
        draw_curves(pages, task, own)
    for task in runs or dict.fromkeys(row["task"] for row in table):
        ladder = sorted((row for row in table if row["task"] == task), key=lambda row: -row["end"])
        write_task(pages, task, ladder)
    print(write_all(pages, table))


if __name__ == "__main__":
    main()
