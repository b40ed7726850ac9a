"""Reproduced tables and figures of the paper, each with the paper's values next to ours."""

from coil_rl.reproduce.classifier import Figure25 as Figure25
from coil_rl.reproduce.figures import Figure10 as Figure10
from coil_rl.reproduce.figures import Figure19 as Figure19
from coil_rl.reproduce.figures import Figure21 as Figure21
from coil_rl.reproduce.figures import Figure26 as Figure26
from coil_rl.reproduce.figures import Figure30 as Figure30
from coil_rl.reproduce.figures import Figure31 as Figure31
from coil_rl.reproduce.result import Result as Result
from coil_rl.reproduce.result import Runs as Runs
from coil_rl.reproduce.robot import Table6 as Table6
from coil_rl.reproduce.tabular_claim import TabularCoil as TabularCoil
from coil_rl.reproduce.toymaker import Figure6 as Figure6
from coil_rl.reproduce.toymaker import Table1 as Table1
from coil_rl.reproduce.training import Figure22 as Figure22
from coil_rl.reproduce.training import Table4 as Table4
from coil_rl.reproduce.unseen import Table5 as Table5
