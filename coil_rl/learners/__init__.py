"""What turns batches of experience into better policies."""

from coil_rl.learners.guide_loss import GuideLoss
from coil_rl.learners.ppo import PPO

__all__ = ["PPO", "GuideLoss"]
