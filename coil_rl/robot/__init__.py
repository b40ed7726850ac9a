"""The robot: its cone classifier, and live driving by its scans."""

from coil_rl.robot.classifier import LabelledClusters as LabelledClusters
from coil_rl.robot.classifier import Scans as Scans
from coil_rl.robot.classifier import Share as Share
from coil_rl.robot.classifier import Training as Training
from coil_rl.robot.classifier import accuracy as accuracy
from coil_rl.robot.classifier import clusters_in_range as clusters_in_range
from coil_rl.robot.classifier import label_clusters as label_clusters
from coil_rl.robot.classifier import load_classifier as load_classifier
from coil_rl.robot.classifier import recall as recall
from coil_rl.robot.classifier import save_classifier as save_classifier
from coil_rl.robot.classifier import share_of as share_of
from coil_rl.robot.classifier import train_on_drives as train_on_drives
from coil_rl.robot.drive_log import DriveLog as DriveLog
from coil_rl.robot.driver import Car as Car
from coil_rl.robot.driver import Command as Command
from coil_rl.robot.driver import LiveDriver as LiveDriver
from coil_rl.robot.driver import Moment as Moment
from coil_rl.robot.setup import Setup as Setup
from coil_rl.robot.setup import setup_of as setup_of
from coil_rl.robot.sources import drive_recording as drive_recording
from coil_rl.robot.sources import drive_simulation as drive_simulation
from coil_rl.robot.watchdog import Limits as Limits
from coil_rl.robot.watchdog import Scan as Scan
