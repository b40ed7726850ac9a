"""Batched TorchRL environments, tracks, recordings and the parts they share."""

from typing import TYPE_CHECKING

from coil_rl.lazy import lazy_names

if TYPE_CHECKING:
    from coil_rl.envs.cone_track import ConeTrackEnv as ConeTrackEnv
    from coil_rl.envs.driving_tasks import DrivingTasksEnv as DrivingTasksEnv
    from coil_rl.envs.level_files import load_track as load_track
    from coil_rl.envs.level_files import load_tracks as load_tracks
    from coil_rl.envs.level_files import save_track as save_track
    from coil_rl.envs.level_files import shipped_track as shipped_track
    from coil_rl.envs.level_files import shipped_tracks as shipped_tracks
    from coil_rl.envs.level_files import track_names as track_names
    from coil_rl.envs.recordings.folders import RecordingError as RecordingError
    from coil_rl.envs.recordings.mcap_files import RecordingWriter as RecordingWriter
    from coil_rl.envs.recordings.reading import read_recording as read_recording
    from coil_rl.envs.recordings.recording import Recording as Recording
    from coil_rl.envs.recordings.replay_env import McapReplayEnv as McapReplayEnv
    from coil_rl.envs.reward import HISTORY as HISTORY
    from coil_rl.envs.reward import recent_mean as recent_mean
    from coil_rl.envs.robot.course import robot_track as robot_track
    from coil_rl.envs.robot.course import robot_tracks as robot_tracks
    from coil_rl.envs.robot.drives import record_drives as record_drives
    from coil_rl.envs.robot.drives import save_drive as save_drive
    from coil_rl.envs.robot.drives import simulated_drive as simulated_drive
    from coil_rl.envs.robot.env import SimulatedRobotEnv as SimulatedRobotEnv
    from coil_rl.envs.robot.lidar import SimulatedLidar as SimulatedLidar
    from coil_rl.envs.robot.perception import ConeClassifier as ConeClassifier
    from coil_rl.envs.robot.perception import Perception as Perception
    from coil_rl.envs.robot.perception import simulated_cone_classifier as simulated_cone_classifier
    from coil_rl.envs.sight import HALF_FIELD_OF_VIEW as HALF_FIELD_OF_VIEW
    from coil_rl.envs.sight import SAMPLES as SAMPLES
    from coil_rl.envs.sight import SIGHT as SIGHT
    from coil_rl.envs.sight import WIDEST_ANGLE as WIDEST_ANGLE
    from coil_rl.envs.sight import Frame as Frame
    from coil_rl.envs.splines import Spline as Spline
    from coil_rl.envs.splines import smoothing_spline as smoothing_spline
    from coil_rl.envs.track import SIDES as SIDES
    from coil_rl.envs.track import Track as Track
    from coil_rl.envs.track import TrackError as TrackError
    from coil_rl.envs.track import resample as resample
    from coil_rl.envs.track_generator import random_track as random_track
    from coil_rl.envs.track_generator import random_tracks as random_tracks
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
