"""Which guide a trained agent listens to, and where on the track."""

from coil_rl.listening.ablation import Ablation, ablations, drive_ablated
from coil_rl.listening.measures import agreement, gradient, intervention
from coil_rl.listening.parts import Intercepted, split
from coil_rl.listening.places import PLACES, Places
from coil_rl.listening.survey import Survey, survey

__all__ = [
    "PLACES",
    "Ablation",
    "Intercepted",
    "Places",
    "Survey",
    "ablations",
    "agreement",
    "drive_ablated",
    "gradient",
    "intervention",
    "split",
    "survey",
]
