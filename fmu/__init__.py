"""Plants as FMUs: files of Modelica, Simulink and others, co-simulated as envs.

It is imported as `coil_fmu`, and uses the public names of `coil_rl` only.
"""

from typing import TYPE_CHECKING

from coil_rl.for_guests import lazy_names

if TYPE_CHECKING:
    from coil_fmu.env import fmu_env as fmu_env
    from coil_fmu.model import Model as Model
    from coil_fmu.plant import FMU as FMU
    from coil_fmu.reward import Follow as Follow
    from coil_fmu.reward import Moment as Moment
    from coil_fmu.setpoints import Course as Course
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
