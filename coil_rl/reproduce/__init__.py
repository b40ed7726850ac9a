"""The paper's tables and figures made again, the paper's value beside ours."""

from coil_rl.reproduce.figure_6 import Figure6
from coil_rl.reproduce.figure_22 import Figure22
from coil_rl.reproduce.figure_25 import Figure25
from coil_rl.reproduce.figure_lines import FigureLines
from coil_rl.reproduce.figure_scan import FigureScan
from coil_rl.reproduce.figure_spline import FigureSpline
from coil_rl.reproduce.figure_world import FigureWorld
from coil_rl.reproduce.result import Result, Runs
from coil_rl.reproduce.table_1 import Table1
from coil_rl.reproduce.table_4 import Table4
from coil_rl.reproduce.table_5 import Table5
from coil_rl.reproduce.table_6 import Table6
from coil_rl.reproduce.tabular_coil import TabularCoil

__all__ = [
    "Figure6",
    "Figure22",
    "Figure25",
    "FigureLines",
    "FigureScan",
    "FigureSpline",
    "FigureWorld",
    "Result",
    "Runs",
    "Table1",
    "Table4",
    "Table5",
    "Table6",
    "TabularCoil",
]
