"""Tables and figures of finished runs."""

from coil_rl.report.curves import draw_curve_grid, draw_learning_curves, draw_phases
from coil_rl.report.intervals import Interval, draw_intervals
from coil_rl.report.lines import animate_lines, draw_lines, draw_listening_map
from coil_rl.report.pictures import DrivenLines, Film, Returns
from coil_rl.report.table import markdown_table, write_csv

__all__ = [
    "DrivenLines",
    "Film",
    "Interval",
    "Returns",
    "animate_lines",
    "draw_curve_grid",
    "draw_intervals",
    "draw_learning_curves",
    "draw_lines",
    "draw_listening_map",
    "draw_phases",
    "markdown_table",
    "write_csv",
]
