"""Guides: controllers that advise an agent. Each is a TensorDictModule that writes an action."""

from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names

if TYPE_CHECKING:
    from coil_rl.cones.racing_line import RacingLineGuide as RacingLineGuide
    from coil_rl.cones.spline import PathPlan as PathPlan
    from coil_rl.cones.spline import SplineGuide as SplineGuide
    from coil_rl.cones.spline_memory import SplineMemoryGuide as SplineMemoryGuide
    from coil_rl.foreign.controllers import ControllerGuide as ControllerGuide
    from coil_rl.foreign.controllers import PerRow as PerRow
    from coil_rl.guides.pid import PID as PID
    from coil_rl.guides.recorded import RecordedGuide as RecordedGuide
    from coil_rl.guides.simple import ConstantGuide as ConstantGuide
    from coil_rl.guides.simple import EntryGuide as EntryGuide
    from coil_rl.guides.simple import FollowAdvice as FollowAdvice
    from coil_rl.guides.simple import RandomGuide as RandomGuide
    from coil_rl.guides.simple import ZeroGuide as ZeroGuide
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
