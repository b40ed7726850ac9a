"""Learning algorithms: each updates a policy from batches of experience."""

from coil_rl.learners.anchor import Anchor as Anchor
from coil_rl.learners.dqn import DQN as DQN
from coil_rl.learners.dynamic_coil import AfterFrames as AfterFrames
from coil_rl.learners.dynamic_coil import AtConvergence as AtConvergence
from coil_rl.learners.dynamic_coil import DynamicCoil as DynamicCoil
from coil_rl.learners.dynamic_coil import PhaseSchedule as PhaseSchedule
from coil_rl.learners.encoders import Cnn as Cnn
from coil_rl.learners.encoders import Gru as Gru
from coil_rl.learners.encoders import Mlp as Mlp
from coil_rl.learners.kickstart import FilteredKickstartLoss as FilteredKickstartLoss
from coil_rl.learners.kickstart import KickstartLoss as KickstartLoss
from coil_rl.learners.policy_gradient import A2C as A2C
from coil_rl.learners.policy_gradient import Reinforce as Reinforce
from coil_rl.learners.ppo import PPO as PPO
from coil_rl.learners.sac import SAC as SAC
from coil_rl.learners.sac_critics import TQC as TQC
from coil_rl.learners.sac_critics import CrossQ as CrossQ
from coil_rl.learners.trpo import TRPO as TRPO
