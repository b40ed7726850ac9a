"""Imitation of guides (paper algorithms 6 and 7)."""

from coil_rl.imitation.imitation import Imitation
from coil_rl.imitation.regressors import NetworkRegressor, Regressor, SklearnRegressor

__all__ = ["Imitation", "NetworkRegressor", "Regressor", "SklearnRegressor"]
