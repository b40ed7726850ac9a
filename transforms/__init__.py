"""TorchRL transforms that bring guides to any env, and that spoil their advice on purpose."""

from coil_rl.transforms.combined_actions import MixedAction, ResidualAction
from coil_rl.transforms.degraded_advice import (
    BiasedAdvice,
    DegradedAdvice,
    PartialAdvice,
    ScaledAdvice,
)
from coil_rl.transforms.discrete_actions import DiscreteActions
from coil_rl.transforms.displaced_advice import DelayedAdvice, RemovedAdvice, ShuffledAdvice
from coil_rl.transforms.drawn_advice import NoisyAdvice, RandomAdvice
from coil_rl.transforms.guide_actions import GuideActions
from coil_rl.transforms.reward_coupling import RewardCoupling
from coil_rl.transforms.takeover import JumpStart, Takeover

__all__ = [
    "BiasedAdvice",
    "DegradedAdvice",
    "DelayedAdvice",
    "DiscreteActions",
    "GuideActions",
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
]
