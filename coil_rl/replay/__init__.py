"""What policies would have steered in a drive that was recorded, and how far they disagree."""

from coil_rl.replay.annotation import annotate, foxglove_layout
from coil_rl.replay.open_loop import RECORDED, OpenLoop, Policies, open_loop
from coil_rl.replay.picture import draw_steering
from coil_rl.replay.tables import describe, over_time

__all__ = [
    "RECORDED",
    "OpenLoop",
    "Policies",
    "annotate",
    "describe",
    "draw_steering",
    "foxglove_layout",
    "open_loop",
    "over_time",
]
