"""The robot's cone classifier: training and evaluation."""

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
