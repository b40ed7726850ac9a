"""Training and measuring what the robot's perception knows: which clusters of a LiDAR scan are thick cones."""

from coil_rl.robot.classifier import (
    Training,
    cone_classifier,
    load_classifier,
    save_classifier,
    train_classifier,
    train_on_drives,
)
from coil_rl.robot.labelling import LabelledClusters, Share, accuracy, label_clusters, recall
from coil_rl.robot.simulated_classifier import train_on_simulated_drives

__all__ = [
    "LabelledClusters",
    "Share",
    "Training",
    "accuracy",
    "cone_classifier",
    "label_clusters",
    "load_classifier",
    "recall",
    "save_classifier",
    "train_classifier",
    "train_on_drives",
    "train_on_simulated_drives",
]
