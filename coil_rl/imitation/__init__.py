"""Imitation of guides (paper algorithms 6 and 7)."""

from coil_rl.imitation.forest import ForestRegressor as ForestRegressor
from coil_rl.imitation.imitation import Imitation as Imitation
from coil_rl.imitation.regressors import LinearRegressor as LinearRegressor
from coil_rl.imitation.regressors import NetworkRegressor as NetworkRegressor
from coil_rl.imitation.regressors import Regressor as Regressor
