"""Learning algorithms: each updates a policy from batches of experience."""

from coil_rl.learners.a2c import A2C
from coil_rl.learners.dqn import DQN
from coil_rl.learners.dynamic_coil import AfterFrames, AtConvergence, DynamicCoil, PhaseSchedule
from coil_rl.learners.encoders import Cnn, Gru, Mlp
from coil_rl.learners.kickstart import KickstartLoss
from coil_rl.learners.noise import NoiseDecay
from coil_rl.learners.ppo import PPO
from coil_rl.learners.reinforce import Reinforce
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
    "Cnn",
    "DynamicCoil",
    "Gru",
    "KickstartLoss",
    "Mlp",
    "NoiseDecay",
    "PhaseSchedule",
    "Reinforce",
]
