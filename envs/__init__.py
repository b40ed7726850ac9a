"""The worlds: batched TorchRL envs and what they are made of."""

from coil_rl.envs.cone_track import ConeTrackEnv
from coil_rl.envs.driving_tasks import DrivingTasksEnv
from coil_rl.envs.level_files import load_track, load_tracks, save_track, shipped_tracks
from coil_rl.envs.tabular_env import TabularEnv
from coil_rl.envs.track import Track, TrackError
from coil_rl.envs.track_generator import random_track, random_tracks

__all__ = [
    "ConeTrackEnv",
    "DrivingTasksEnv",
    "TabularEnv",
    "Track",
    "TrackError",
    "load_track",
    "load_tracks",
    "random_track",
    "random_tracks",
    "save_track",
    "shipped_tracks",
]
