"""The cone world's guest of the library: its guides, its pictures, and the program `coil-demo`.

The world itself is in `coil_rl.envs`. The names here are also those of `coil_rl.guides` and
`coil_rl.report`.
"""

from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names

if TYPE_CHECKING:
    from coil_rl.cones.cone_planner import ConePlannerGuide as ConePlannerGuide
    from coil_rl.cones.lines import draw_listening_map as draw_listening_map
    from coil_rl.cones.pictures import DrivenLines as DrivenLines
    from coil_rl.cones.racing_line import RacingLineGuide as RacingLineGuide
    from coil_rl.cones.spline import PathPlan as PathPlan
    from coil_rl.cones.spline import SplineGuide as SplineGuide
    from coil_rl.cones.spline_memory import SplineMemoryGuide as SplineMemoryGuide
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
