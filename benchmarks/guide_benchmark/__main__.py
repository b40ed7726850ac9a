"""Command line of the guide benchmark: the pages and the table of finished runs.

    python -m benchmarks.guide_benchmark outputs/experiments/guide_benchmark

Each folder in it has the runs of one task. With `--add FILE` the rows join a table that exists; a
row of the same task, method, arm and configuration is replaced.
"""

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.guide_benchmark.pages import write_all, write_task
from benchmarks.guide_benchmark.rows import benchmark_rows, check_row
from coil_rl.report import read_runs, write_csv
from coil_rl.report.runs import failed_jobs

SAME = ("task", "method", "arm", "fingerprint")  # of two rows that replace each other


def added(file: Path, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of a file, with others in place of their older forms or behind them.

    Args:
        file: a table of rows; it need not exist.
        rows: that join it.

    Raises:
        ValueError: if a row of the file is not valid.
    """
    if not file.exists():
        return list(rows)
    with file.open(encoding="utf-8", newline="") as table:
        known: list[dict[str, Any]] = list(csv.DictReader(table))
    for row in known:
        check_row(row)
    new = {tuple(row[name] for name in SAME) for row in rows}
    return [row for row in known if tuple(row[name] for name in SAME) not in new] + list(rows)


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
    pages.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for task in sorted(path.name for path in given.folder.iterdir() if path.is_dir()):
        if task == pages.name:
            continue
        runs = read_runs([given.folder / task])
        found = benchmark_rows(task, runs)
        if found:
            write_task(pages, task, found, runs, failed_jobs([given.folder / task]))
        else:
            print(f"{task}: no finished run of plain PPO; begin with +arm=alone method=ppo")
        rows += found
    if not rows:
        parser.error(f"{given.folder} has no task with a finished run of plain PPO")
    write_csv(rows, pages / "rows.csv")
    if given.add:
        write_csv(added(given.add, rows), given.add)
    print(write_all(pages, rows))


if __name__ == "__main__":
    main()
