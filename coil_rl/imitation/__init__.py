"""Learning to act as a guide does, from what it says (paper algorithms 6 and 7)."""

from coil_rl.imitation.imitation import Imitation
from coil_rl.imitation.network import Network
from coil_rl.imitation.regressor import Regressor
from coil_rl.imitation.scikit import Sklearn

__all__ = ["Imitation", "Network", "Regressor", "Sklearn"]
