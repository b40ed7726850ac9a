"""A supply chain of gym-invmgmt with a base stock for each of its three stores.

python -m pip install gym-invmgmt==0.2.1
"""

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TransformAction
from numpy.typing import NDArray

LARGEST_ORDER = 100.0  # units a period, the capacity of the factory; the env allows thousands
ID = "gym_invmgmt:GymInvMgmt/Serial-v0"


def serial() -> gymnasium.Env:
    """Return the chain of retailer, distributor and factory, with bounded orders."""
    return TransformAction(gymnasium.make(ID), np.asarray, Box(0.0, LARGEST_ORDER, (3,)))


class BaseStocks:
    """Orders what each store lacks of its level, on hand and on the way.

    Args:
        margin: standard deviations of the demand until a delivery that are kept beside its mean.
        demand: mean units a period, Poisson.
    """

    def __init__(self, margin: float = 1.6, demand: float = 20.0) -> None:
        mean = demand * (1 + np.array([4, 4, 0]))  # periods until a delivery arrives
        self.levels = mean + margin * np.sqrt(mean)

    def act(self, observation: NDArray) -> NDArray:
        """Return the orders [3]; the env gives demand, backlog, stock [3], deliveries [2 x 4]."""
        stock = observation[2:5].copy()
        stock[:2] += observation[5:13].reshape(2, 4).sum(-1)
        stock[0] -= observation[1]
        return (self.levels - stock).clip(0.0, LARGEST_ORDER)
