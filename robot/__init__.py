"""The robot: recordings replayed and imitated, its cone classifier, and live driving by its scans.

It is imported as `coil_robot`, and uses the public names of `coil_rl` only.
"""

from typing import TYPE_CHECKING

from coil_rl.for_guests import lazy_names

if TYPE_CHECKING:
    from coil_robot.classifier import Scans as Scans
    from coil_robot.classifier import Share as Share
    from coil_robot.classifier import Training as Training
    from coil_robot.classifier import accuracy as accuracy
    from coil_robot.classifier import clusters_in_range as clusters_in_range
    from coil_robot.classifier import label_clusters as label_clusters
    from coil_robot.classifier import load_classifier as load_classifier
    from coil_robot.classifier import recall as recall
    from coil_robot.classifier import save_classifier as save_classifier
    from coil_robot.classifier import share_of as share_of
    from coil_robot.classifier import train_on_drives as train_on_drives
    from coil_robot.drive_log import DriveLog as DriveLog
    from coil_robot.driver import Car as Car
    from coil_robot.driver import Command as Command
    from coil_robot.driver import LiveDriver as LiveDriver
    from coil_robot.driver import Moment as Moment
    from coil_robot.recording_guide import RecordingGuide as RecordingGuide
    from coil_robot.replay.open_loop import recorded_steering as recorded_steering
    from coil_robot.setup import Setup as Setup
    from coil_robot.setup import setup_of as setup_of
    from coil_robot.sources import drive_recording as drive_recording
    from coil_robot.sources import drive_simulation as drive_simulation
    from coil_robot.watchdog import Limits as Limits
    from coil_robot.watchdog import Scan as Scan
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
