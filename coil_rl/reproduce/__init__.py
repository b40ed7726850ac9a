"""Reproduced tables and figures of the paper, each with the paper's values next to ours."""

from coil_rl.reproduce.classifier import Figure25
from coil_rl.reproduce.result import Result, Runs
from coil_rl.reproduce.robot import Table6
from coil_rl.reproduce.tabular_claim import TabularCoil
from coil_rl.reproduce.toymaker import Figure6, Table1
from coil_rl.reproduce.training import Figure22, Table4
from coil_rl.reproduce.unseen import Table5

__all__ = ["Figure6", "Figure22", "Figure25", "Result", "Runs", "Table1", "Table4", "Table5", "Table6", "TabularCoil"]
