"""TorchRL transforms that bring guides to any env, and that spoil their advice on purpose."""

from coil_rl.transforms.degraded_advice import (
    BiasedAdvice,
    DegradedAdvice,
    NoisyAdvice,
    PartialAdvice,
    ScaledAdvice,
)
from coil_rl.transforms.displaced_advice import DelayedAdvice, RemovedAdvice, ShuffledAdvice
from coil_rl.transforms.guide_actions import GuideActions

__all__ = [
    "BiasedAdvice",
    "DegradedAdvice",
    "DelayedAdvice",
    "GuideActions",
    "NoisyAdvice",
    "PartialAdvice",
    "RemovedAdvice",
    "ScaledAdvice",
    "ShuffledAdvice",
]
