"""Guides: controllers that advise an agent. Each is a TensorDictModule that writes an action."""

from coil_rl.guides.controllers import ControllerGuide, EntryGuide, PerRow, RecordedGuide
from coil_rl.guides.racing_line import RacingLineGuide
from coil_rl.guides.simple import ConstantGuide, FollowAdvice, RandomGuide, ZeroGuide
from coil_rl.guides.spline import SplineGuide

__all__ = [
    "ConstantGuide",
    "ControllerGuide",
    "EntryGuide",
    "FollowAdvice",
    "PerRow",
    "RacingLineGuide",
    "RandomGuide",
    "RecordedGuide",
    "SplineGuide",
    "ZeroGuide",
]
