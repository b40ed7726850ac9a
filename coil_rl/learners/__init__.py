"""What turns batches of experience into better policies."""

from coil_rl.learners.a2c import A2C
from coil_rl.learners.dqn import DQN
from coil_rl.learners.dynamic_coil import DynamicCoil
from coil_rl.learners.guide_loss import GuideLoss
from coil_rl.learners.phases import AfterFrames, AtConvergence, Phases
from coil_rl.learners.ppo import PPO
from coil_rl.learners.reinforce import Reinforce
from coil_rl.learners.replay import Replay
from coil_rl.learners.sac import SAC
from coil_rl.learners.trpo import TRPO

__all__ = [
    "A2C",
    "DQN",
    "PPO",
    "SAC",
    "TRPO",
    "AfterFrames",
    "AtConvergence",
    "DynamicCoil",
    "GuideLoss",
    "Phases",
    "Reinforce",
    "Replay",
]
