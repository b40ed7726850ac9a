"""Batched TorchRL environments, tracks, recordings and the parts they share."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from coil_rl.envs.cone_track import ConeTrackEnv
from coil_rl.envs.driving_tasks import DrivingTasksEnv
from coil_rl.envs.env_batch import EnvBatch
from coil_rl.envs.level_files import load_track, load_tracks, save_track, shipped_track, shipped_tracks, track_names
from coil_rl.envs.recordings.mcap_files import RecordingWriter
from coil_rl.envs.recordings.reading import Recording, RecordingError, read_recording
from coil_rl.envs.recordings.replay_env import McapReplayEnv
from coil_rl.envs.robot.course import robot_track, robot_tracks
from coil_rl.envs.robot.drives import SimulatedDrive, labelling_drives, record_drives, save_drive, simulated_drive
from coil_rl.envs.robot.env import SimulatedRobotEnv
from coil_rl.envs.robot.lidar import SimulatedLidar
from coil_rl.envs.robot.perception import ConeClassifier, Perception, simulated_cone_classifier
from coil_rl.envs.track import Track, TrackError
from coil_rl.envs.track_generator import random_track, random_tracks

if TYPE_CHECKING:
    from coil_rl.envs.gymnasium_env import GymnasiumEnv

__all__ = [
    "ConeClassifier",
    "ConeTrackEnv",
    "DrivingTasksEnv",
    "EnvBatch",
    "GymnasiumEnv",
    "McapReplayEnv",
    "Perception",
    "Recording",
    "RecordingError",
    "RecordingWriter",
    "SimulatedDrive",
    "SimulatedLidar",
    "SimulatedRobotEnv",
    "Track",
    "TrackError",
    "labelling_drives",
    "load_track",
    "load_tracks",
    "random_track",
    "random_tracks",
    "read_recording",
    "record_drives",
    "robot_track",
    "robot_tracks",
    "save_drive",
    "save_track",
    "shipped_track",
    "shipped_tracks",
    "simulated_cone_classifier",
    "simulated_drive",
    "track_names",
]


def __getattr__(name: str) -> Any:
    # On first use, because importing Gymnasium takes time.
    if name != "GymnasiumEnv":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module("coil_rl.envs.gymnasium_env").GymnasiumEnv
