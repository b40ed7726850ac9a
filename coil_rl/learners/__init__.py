"""What turns batches of experience into better policies."""

from coil_rl.learners.a2c import A2C
from coil_rl.learners.dynamic_coil import DynamicCoil
from coil_rl.learners.guide_loss import GuideLoss
from coil_rl.learners.phases import AfterFrames, AtConvergence, Phases
from coil_rl.learners.ppo import PPO
from coil_rl.learners.reinforce import Reinforce
from coil_rl.learners.trpo import TRPO

__all__ = ["A2C", "PPO", "TRPO", "AfterFrames", "AtConvergence", "DynamicCoil", "GuideLoss", "Phases", "Reinforce"]
