"""Command line of the guide benchmark: the pages and the table of finished runs.

    python -m benchmarks.guide_benchmark outputs/experiments/guide_benchmark

Each folder in it has the runs of one task. With `--add FILE` the rows join a table that exists; a
row of the same task, method, arm and configuration is replaced. The page that holds all tasks is
then of the whole table.
"""

import argparse
import csv
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from benchmarks.guide_benchmark.pages import write_all, write_task
from benchmarks.guide_benchmark.rows import benchmark_rows, check_row, numbers_of, read_rows
from coil_rl.errors import UserError
from coil_rl.report import read_runs, write_csv
from coil_rl.report.runs import failed_jobs

SAME = ("task", "method", "arm", "fingerprint")  # of two rows that replace each other


def added(file: Path, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a file, with others in place of their older forms or behind them.

    Args:
        file: a table of rows; it need not exist.
        rows: that join it.

    Raises:
        ValueError: if a row is not valid.
    """
    for row in rows:
        check_row({name: str(value) for name, value in row.items()})
    if not file.exists():
        return list(rows)
    known: list[dict[str, Any]] = [numbers_of(row) for row in read_rows(file)]
    new = {tuple(row[name] for name in SAME) for row in rows}
    return [row for row in known if tuple(row[name] for name in SAME) not in new] + list(rows)


def measured(folder: Path, pages: Path) -> list[dict[str, Any]]:
    """Return the rows of all tasks, and write the page of each.

    Args:
        folder: with a folder for each task.
        pages: where to write.

    Raises:
        ValueError: if a task has no reference, or none a finished run of plain PPO.
        UserError: if a folder has no runs, or a damaged one.
    """
    tasks = [path for path in sorted(folder.iterdir()) if path.is_dir() and path != pages]
    runs = {path: read_runs([path]) for path in tasks if not path.name.startswith(".")}
    rows = {path: benchmark_rows(path.name, runs[path]) for path in runs}
    if not any(rows.values()):
        raise ValueError(f"{folder} has no task with plain PPO; train it: +arm=alone method=ppo")
    for path, found in rows.items():
        if found:
            pages.mkdir(parents=True, exist_ok=True)
            write_task(pages, path.name, found, runs[path], failed_jobs([path]))
        else:
            print(f"{path.name} is left out: it has no plain PPO; train +arm=alone method=ppo")
    return list(chain.from_iterable(rows.values()))


def main() -> None:
    """Write the pages and the table, and print the page that holds all tasks."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of the experiments, with a folder for each task")
    parser.add_argument("--pages", type=Path, help="where to write; FOLDER/pages by default")
    parser.add_argument("--add", type=Path, help="table of rows that the new ones join")
    given = parser.parse_args()
    if not given.folder.is_dir():
        parser.error(f"{given.folder} does not exist; give the folder of the experiments")
    pages = given.pages or given.folder / "pages"
    try:
        rows = measured(given.folder, pages)
        table = added(given.add, rows) if given.add else rows
    except (ValueError, UserError, csv.Error) as error:
        parser.error(str(error))
    for file in {pages / "rows.csv", given.add or pages / "rows.csv"}:
        write_csv(table, file)
    print(write_all(pages, table))


if __name__ == "__main__":
    main()
