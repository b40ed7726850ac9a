"""Tables and figures of finished runs."""

from coil_rl.report.curves import draw_curve_grid as draw_curve_grid
from coil_rl.report.curves import draw_learning_curves as draw_learning_curves
from coil_rl.report.curves import draw_phases as draw_phases
from coil_rl.report.intervals import Interval as Interval
from coil_rl.report.intervals import draw_intervals as draw_intervals
from coil_rl.report.intervals import driver_intervals as driver_intervals
from coil_rl.report.lines import draw_listening_map as draw_listening_map
from coil_rl.report.pictures import DrivenLines as DrivenLines
from coil_rl.report.pictures import Film as Film
from coil_rl.report.pictures import Returns as Returns
from coil_rl.report.table import markdown_table as markdown_table
from coil_rl.report.table import write_csv as write_csv
