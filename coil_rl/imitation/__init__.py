"""Imitation of guides (paper algorithms 6 and 7)."""

from coil_rl.imitation.imitation import Imitation as Imitation
from coil_rl.imitation.regressors import NetworkRegressor as NetworkRegressor
from coil_rl.imitation.regressors import Regressor as Regressor
from coil_rl.imitation.regressors import SklearnRegressor as SklearnRegressor
