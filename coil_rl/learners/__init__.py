"""What turns batches of experience into better policies."""

from coil_rl.learners.dynamic_coil import DynamicCoil
from coil_rl.learners.guide_loss import GuideLoss
from coil_rl.learners.phases import AfterFrames, AtConvergence, Phases
from coil_rl.learners.ppo import PPO

__all__ = ["PPO", "AfterFrames", "AtConvergence", "DynamicCoil", "GuideLoss", "Phases"]
