"""The cone world's guest of the library: its guides, its pictures, and the program `coil-demo`.

The world itself is in `coil_rl.envs`; other guides and the picture of an evaluation have their
names in `coil_rl.guides` and `coil_rl.report`.
"""

from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names

if TYPE_CHECKING:
    from coil_rl.cones.cone_planner import ConePlannerGuide as ConePlannerGuide
    from coil_rl.cones.lines import draw_listening_map as draw_listening_map
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
