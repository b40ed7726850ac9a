"""Tables and figures of finished runs."""

from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names

if TYPE_CHECKING:
    from coil_rl.cones.pictures import DrivenLines as DrivenLines
    from coil_rl.report import style as style
    from coil_rl.report.comparison import Comparison as Comparison
    from coil_rl.report.comparison import Group as Group
    from coil_rl.report.comparison import compare as compare
    from coil_rl.report.comparison import paired as paired
    from coil_rl.report.configurations import differing as differing
    from coil_rl.report.curves import draw_learning_curves as draw_learning_curves
    from coil_rl.report.curves import frames_until as frames_until
    from coil_rl.report.curves import guide_return as guide_return
    from coil_rl.report.curves import learning as learning
    from coil_rl.report.curves import mean_curve as mean_curve
    from coil_rl.report.curves import points as points
    from coil_rl.report.film import Film as Film
    from coil_rl.report.in_time import InTime as InTime
    from coil_rl.report.intervals import Interval as Interval
    from coil_rl.report.intervals import draw_intervals as draw_intervals
    from coil_rl.report.intervals import driver_intervals as driver_intervals
    from coil_rl.report.page import cases_table as cases_table
    from coil_rl.report.page import with_cells as with_cells
    from coil_rl.report.pictures import Returns as Returns
    from coil_rl.report.runs import GUIDE as GUIDE
    from coil_rl.report.runs import RETURN as RETURN
    from coil_rl.report.runs import TERM as TERM
    from coil_rl.report.runs import Run as Run
    from coil_rl.report.runs import read_runs as read_runs
    from coil_rl.report.sentences import listed as listed
    from coil_rl.report.statistics import SIGN_FLIP_SEEDS as SIGN_FLIP_SEEDS
    from coil_rl.report.statistics import Estimate as Estimate
    from coil_rl.report.statistics import count_of_seeds as count_of_seeds
    from coil_rl.report.statistics import estimate as estimate
    from coil_rl.report.statistics import holm as holm
    from coil_rl.report.statistics import wins as wins
    from coil_rl.report.table import markdown_table as markdown_table
    from coil_rl.report.table import p_text as p_text
    from coil_rl.report.table import write_csv as write_csv
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
