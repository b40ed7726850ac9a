"""Batched TorchRL environments, tracks, recordings and the parts they share."""

from coil_rl.envs.cone_track import ConeTrackEnv
from coil_rl.envs.driving_tasks import DrivingTasksEnv
from coil_rl.envs.level_files import load_track, load_tracks, save_track, shipped_track, shipped_tracks
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

__all__ = [
    "ConeClassifier",
    "ConeTrackEnv",
    "DrivingTasksEnv",
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
]
