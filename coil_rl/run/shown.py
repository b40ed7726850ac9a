"""A run as an interpreter and a notebook show it: one line, and a table with the learning curve."""

from __future__ import annotations

import base64
from html import escape
from typing import TYPE_CHECKING

from coil_rl import record
from coil_rl.files import LARGEST_TABLE, read_file
from coil_rl.measures import MEAN_CASE, measures_of
from coil_rl.report.table import return_format
from coil_rl.run.folder import is_begun

if TYPE_CHECKING:
    from coil_rl.run.run import Run


def line_of(run: Run) -> str:
    """Return what a run is, and how far it is."""
    rows = [row for row in _means(run) if row["driver"] == run.label]
    state = "begun" if is_begun(run.folder) else "new"
    if _means(run):
        state = "finished"
    if rows:
        reward = rows[0]["reward"]
        state += f" with return {reward:{return_format([reward])}}"
    frames = f"{run.budget.frames:,} frames, " if run.has_agent else ""
    return f"<Run {run.label}, seed {run.seed}, {frames}{state}, in {run.folder}>"


def page_of(run: Run) -> str:
    """Return the line as HTML, with the means of the evaluation and the learning curve."""
    import pandas as pd  # a training does without it

    parts, rows = [f"<p>{escape(line_of(run))}</p>"], _means(run)
    if rows:
        measures = measures_of((run.settings.get("evaluation") or {}).get("measures") or {})
        titles = {name: text for name, each in measures.items() if (text := each.heading(name))}
        counts = [name for name in rows[0] if name.endswith("episodes") and name not in measures]
        columns = ["driver", "advice", "actions", "reward", *titles, *counts]
        table = pd.DataFrame(rows, columns=columns)
        table = table.rename(columns=titles)
        parts.append(table.to_html(index=False, float_format="{:.4g}".format, na_rep="-"))
    picture = run.folder / "learning_curve.png"
    if picture.is_file():
        content = base64.b64encode(read_file(picture, LARGEST_TABLE)).decode()
        parts.append(f'<img width="640" src="data:image/png;base64,{content}">')
    return "\n".join(parts)


def _means(run: Run) -> list[record.Row]:
    """Return the means of a finished run; none of another one."""
    rows = record.EVALUATION.read(run.folder) or []
    return [row for row in rows if row["case"] == MEAN_CASE]
