"""The paper's tables and figures made again, the paper's value beside ours."""

from coil_rl.reproduce.figure_6 import Figure6
from coil_rl.reproduce.result import Result
from coil_rl.reproduce.table_1 import Table1
from coil_rl.reproduce.tabular_coil import TabularCoil

__all__ = ["Figure6", "Result", "Table1", "TabularCoil"]
