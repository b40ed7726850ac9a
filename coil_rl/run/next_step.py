"""What to type after a run."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from coil_rl.report.runs import RETURN
from coil_rl.run.stopping import command_of, resume_command

RISE = 0.05  # of the range of a curve: a rise of its last quarter that is worth more training


def still_rising(rows: Sequence[Mapping[str, float]]) -> bool:
    """Return whether the return of the kept policies was still rising at the end of a run.

    Args:
        rows: of `metrics.csv`.
    """
    returns = [row[RETURN] for row in rows if not math.isnan(row.get(RETURN, math.nan))]
    quarter = len(returns) // 4
    if quarter < 1:
        return False
    before, last = max(returns[:-quarter]), max(returns[-quarter:])
    return last - before > RISE * (max(returns) - min(returns))


def next_step(folder: Path, frames: int, rows: Sequence[Mapping[str, float]] = ()) -> str:
    """Return a line with the commands that usually follow a finished training.

    Args:
        rows: of `metrics.csv`.
    """
    longer = f"{resume_command(folder)} budget.frames={2 * frames}"
    report = f"coil-report folder={shlex.quote(str(folder.parent))}"
    if still_rising(rows):
        return f"Still rising at the end: {longer}"
    return f"Next: {command_of('coil-evaluate', 'run', folder)} | {report} | {longer}"
