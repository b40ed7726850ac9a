"""Two tasks of decisionrl with the controllers that it compares itself with.

python -m pip install decisionrl==0.4.0
"""

from typing import Any

from decisionrl.baselines import base_stock, price_threshold_battery
from decisionrl.envs import EnergyMicrogrid, InventoryManagement
from decisionrl.envs.gym import to_gymnasium
from gymnasium import Env
from numpy.typing import NDArray


def microgrid() -> Env:
    """Return a battery that is charged and discharged at changing prices."""
    return to_gymnasium(EnergyMicrogrid())


def inventory() -> Env:
    """Return a store that orders from 0 to 10 units a day."""
    return to_gymnasium(InventoryManagement())


class PriceThreshold:
    """Charges at low prices and discharges at high ones.

    Args:
        low: price below which it charges, as a share of 1.5; it discharges above 1 - low.
    """

    def __init__(self, low: float = 0.35) -> None:
        self.rule: Any = price_threshold_battery(low)

    def act(self, observation: NDArray) -> NDArray:
        """Return the power [1]."""
        power: NDArray = self.rule(None, observation)
        return power


class BaseStock:
    """Orders up to a level.

    Args:
        level: units.
    """

    def __init__(self, level: float = 9.0) -> None:
        self.rule: Any = base_stock(level)
        self.store = InventoryManagement()

    def act(self, observation: NDArray) -> int:
        """Return the number of units."""
        units: int = self.rule(self.store, observation)
        return units
