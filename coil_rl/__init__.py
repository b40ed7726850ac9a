"""Reinforcement learning with guide policies.

The names in `__all__` are the public API. They are imported on first use, so that `import coil_rl`
is fast.
"""

import logging
import os
from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names

# TorchRL logs each storage that it makes. It reads the variable when it is imported, maybe before.
logging.getLogger("torchrl").setLevel(os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING"))

if TYPE_CHECKING:
    from coil_rl.comparison.compare import compare as compare
    from coil_rl.config.assemble import LearnedGuide as LearnedGuide
    from coil_rl.config.compose import check_values as check_values
    from coil_rl.config.compose import compose_train as compose_train
    from coil_rl.config.folder import pretrained_card as pretrained_card
    from coil_rl.config.folder import pretrained_names as pretrained_names
    from coil_rl.config.nodes import build as build
    from coil_rl.config.python import open_run as open_run
    from coil_rl.config.python import prepare as prepare
    from coil_rl.config.python import pretrained as pretrained
    from coil_rl.config.python import train as train
    from coil_rl.config.schema import NodeConfig as NodeConfig
    from coil_rl.config.schema import ProgramConfig as ProgramConfig
    from coil_rl.config.trust import trust_packages as trust_packages
    from coil_rl.envs import ConeTrackEnv as ConeTrackEnv
    from coil_rl.envs import DrivingTasksEnv as DrivingTasksEnv
    from coil_rl.envs import McapReplayEnv as McapReplayEnv
    from coil_rl.envs import SimulatedRobotEnv as SimulatedRobotEnv
    from coil_rl.envs import Track as Track
    from coil_rl.envs import load_track as load_track
    from coil_rl.envs import load_tracks as load_tracks
    from coil_rl.envs import random_tracks as random_tracks
    from coil_rl.envs import shipped_tracks as shipped_tracks
    from coil_rl.errors import UserError as UserError
    from coil_rl.errors import did_you_mean as did_you_mean
    from coil_rl.export import ExportedGuide as ExportedGuide
    from coil_rl.export import ExportedPolicy as ExportedPolicy
    from coil_rl.export import export_policy as export_policy
    from coil_rl.files import write_text as write_text
    from coil_rl.foreign.gymnasium_env import GymnasiumEnv as GymnasiumEnv
    from coil_rl.foreign.torchrl_env import EnvBatch as EnvBatch
    from coil_rl.guides import ConstantGuide as ConstantGuide
    from coil_rl.guides import ControllerGuide as ControllerGuide
    from coil_rl.guides import EntryGuide as EntryGuide
    from coil_rl.guides import PerRow as PerRow
    from coil_rl.guides import RandomGuide as RandomGuide
    from coil_rl.guides import RecordedGuide as RecordedGuide
    from coil_rl.guides import SplineGuide as SplineGuide
    from coil_rl.guides import ZeroGuide as ZeroGuide
    from coil_rl.guides.advice_observation import AdviceObservation as AdviceObservation
    from coil_rl.imitation import Imitation as Imitation
    from coil_rl.learners import A2C as A2C
    from coil_rl.learners import DQN as DQN
    from coil_rl.learners import PPO as PPO
    from coil_rl.learners import SAC as SAC
    from coil_rl.learners import TRPO as TRPO
    from coil_rl.learners import DynamicCoil as DynamicCoil
    from coil_rl.learners import Reinforce as Reinforce
    from coil_rl.learners.stepper import LearnerStepper as LearnerStepper
    from coil_rl.measures import Measure as Measure
    from coil_rl.programs.app import run_program as run_program
    from coil_rl.run.controller import Controller as Controller
    from coil_rl.run.evaluation import EvaluationResult as EvaluationResult
    from coil_rl.run.evaluation import evaluate_policy as evaluate_policy
    from coil_rl.run.folder import versions as versions
    from coil_rl.run.judge import Evaluation as Evaluation
    from coil_rl.run.judge import Trial as Trial
    from coil_rl.run.judge import guide_titles as guide_titles
    from coil_rl.run.parts import EnvMaker as EnvMaker
    from coil_rl.run.rollout import Rollout as Rollout
    from coil_rl.run.run import Budget as Budget
    from coil_rl.run.run import Run as Run
    from coil_rl.testing import check_env as check_env
    from coil_rl.testing import check_guide as check_guide
    from coil_rl.testing import check_transform as check_transform
    from coil_rl.transforms import DiscreteActions as DiscreteActions
    from coil_rl.transforms import GuideActions as GuideActions
    from coil_rl.transforms import JumpStart as JumpStart
    from coil_rl.transforms import MixedAction as MixedAction
    from coil_rl.transforms import NormalisedAction as NormalisedAction
    from coil_rl.transforms import ResidualAction as ResidualAction
    from coil_rl.transforms import RewardCoupling as RewardCoupling
    from coil_rl.transforms import set_progress as set_progress
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
