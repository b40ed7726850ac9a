"""Analysis of how much a trained agent uses the advice of each guide, and where on the track."""

from coil_rl.listening.measures import InterceptedPolicy, agreement, gradient, intervention, split_policy
from coil_rl.listening.sections import SECTIONS, TrackSections
from coil_rl.listening.survey import Ablation, Survey, ablations, drive_ablated, survey

__all__ = [
    "SECTIONS",
    "Ablation",
    "InterceptedPolicy",
    "Survey",
    "TrackSections",
    "ablations",
    "agreement",
    "drive_ablated",
    "gradient",
    "intervention",
    "split_policy",
    "survey",
]
