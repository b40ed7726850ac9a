"""TorchRL transforms that bring guides to any env.

`GuideActions` writes advice into the observation. Most others use it: they combine the actions of
agent and guide, couple the reward to the advice, leave the advice out or degrade it. Delays and
noise make the env itself worse, for guides and agents alike.
"""

from coil_rl.transforms.action_delay import ActionDelay as ActionDelay
from coil_rl.transforms.advice_dropout import AdviceDropout as AdviceDropout
from coil_rl.transforms.combined_actions import AdaptiveMixedAction as AdaptiveMixedAction
from coil_rl.transforms.combined_actions import GradualResidual as GradualResidual
from coil_rl.transforms.combined_actions import JumpStart as JumpStart
from coil_rl.transforms.combined_actions import MixedAction as MixedAction
from coil_rl.transforms.combined_actions import ResidualAction as ResidualAction
from coil_rl.transforms.combined_actions import Takeover as Takeover
from coil_rl.transforms.degraded_advice import BiasedAdvice as BiasedAdvice
from coil_rl.transforms.degraded_advice import DegradedAdvice as DegradedAdvice
from coil_rl.transforms.degraded_advice import DelayedAdvice as DelayedAdvice
from coil_rl.transforms.degraded_advice import NoisyAdvice as NoisyAdvice
from coil_rl.transforms.degraded_advice import PartialAdvice as PartialAdvice
from coil_rl.transforms.degraded_advice import RandomAdvice as RandomAdvice
from coil_rl.transforms.degraded_advice import RemovedAdvice as RemovedAdvice
from coil_rl.transforms.degraded_advice import ScaledAdvice as ScaledAdvice
from coil_rl.transforms.degraded_advice import ShuffledAdvice as ShuffledAdvice
from coil_rl.transforms.discrete_actions import DiscreteActions as DiscreteActions
from coil_rl.transforms.disturbance import Disturbance as Disturbance
from coil_rl.transforms.guide_actions import GuideActions as GuideActions
from coil_rl.transforms.guide_actions import Guides as Guides
from coil_rl.transforms.guide_transform import GuideTransform as GuideTransform
from coil_rl.transforms.guide_transform import set_progress as set_progress
from coil_rl.transforms.last_action import LastAction as LastAction
from coil_rl.transforms.normalised_action import NormalisedAction as NormalisedAction
from coil_rl.transforms.observation_delay import ObservationDelay as ObservationDelay
from coil_rl.transforms.observation_noise import ObservationNoise as ObservationNoise
from coil_rl.transforms.reward_coupling import RewardCoupling as RewardCoupling
