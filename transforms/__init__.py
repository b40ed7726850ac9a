"""TorchRL transforms for guides in any env: advice, combined actions, reward coupling, degraded advice."""

from coil_rl.transforms.combined_actions import JumpStart, MixedAction, ResidualAction, Takeover
from coil_rl.transforms.degraded_advice import (
    BiasedAdvice,
    DegradedAdvice,
    DelayedAdvice,
    NoisyAdvice,
    PartialAdvice,
    RandomAdvice,
    RemovedAdvice,
    ScaledAdvice,
    ShuffledAdvice,
)
from coil_rl.transforms.discrete_actions import DiscreteActions
from coil_rl.transforms.guide_actions import GuideActions, Guides
from coil_rl.transforms.guide_transform import GuideTransform, set_progress
from coil_rl.transforms.reward_coupling import RewardCoupling

__all__ = [
    "BiasedAdvice",
    "DegradedAdvice",
    "DelayedAdvice",
    "DiscreteActions",
    "GuideActions",
    "GuideTransform",
    "Guides",
    "JumpStart",
    "MixedAction",
    "NoisyAdvice",
    "PartialAdvice",
    "RandomAdvice",
    "RemovedAdvice",
    "ResidualAction",
    "RewardCoupling",
    "ScaledAdvice",
    "ShuffledAdvice",
    "Takeover",
    "set_progress",
]
