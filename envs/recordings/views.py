"""Whether a perception fits a recording.

A scan that is mirrored or turned, or one of a room, gives numbers like any other one. What the
perception sees in all scans together tells them apart.
"""

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.recordings.recording import Recording
from coil_rl.envs.robot.perception import Perception

CHECKED_SCANS = 512  # of a recording at most, evenly spread
MOST = 0.5  # share of the clusters, and of the scans
# Of the scans with both boundaries 0.97 and more with 30 % of the cones missing, see docs/robot.md.
IN_ORDER = 0.5


def caution_about_view(
    recording: Recording,
    cones: NDArray[np.float32],
    count: NDArray[np.int64],
    both_valid: NDArray[np.bool_],
    perception: object,
) -> str:
    """Return a warning if a perception hardly fits a recording of N scans, else nothing.

    It does not if few scans show both boundaries, if the left one is right of the right one, or if
    most clusters in sight are no cones.

    Args:
        cones: [N, 2, K, 2] m in the car's frame, left side first.
        count: [N, 2], number of the cones.
        both_valid: [N], whether both boundaries are valid in a scan.
        perception: of the env; only a `Perception` is asked for the clusters.
    """
    problems = []
    if not both_valid.any():
        problems.append("no scan shows both boundaries")
    elif both_valid.mean() < MOST:
        problems.append(f"only {both_valid.mean():.0%} of the scans show both boundaries")
    order = share_in_order(cones, count)
    if order < IN_ORDER:
        problems.append(
            f"the left cones lie left of the right ones in only {order:.0%} of the scans with both "
            "(the scans are mirrored, as of a laser that is upside down; or turned, see "
            "perception.laser_yaw, 180 for a laser that points backwards; or thin cones stand on "
            "the right)"
        )
    if isinstance(perception, Perception):
        some = slice(None, None, -(-len(recording.ranges) // CHECKED_SCANS))
        rejected = perception.rejected(recording.ranges[some], recording.angles(some))
        if rejected > MOST:
            problems.append(
                f"{rejected:.0%} of the clusters in sight are unlike any cone of the training"
            )
    if not problems:
        return ""
    return (
        f"{recording.path}: {' and '.join(problems)}, so the actions mean little; "
        "check env.perception, or train the classifier on your own cones "
        "with coil-reproduce figure=25"
    )


def share_in_order(cones: NDArray[np.float32], count: NDArray[np.int64]) -> float:
    """Return the share of the scans with cones of both sides in which the left ones lie left.

    Compared are the means of the coordinate to the left. Without such scans it is 1.

    Args:
        cones: [N, 2, K, 2] m in the car's frame, left side first, padded.
        count: [N, 2], number of the cones.
    """
    real = np.arange(cones.shape[2]) < count[..., None]
    total = np.where(real, cones[..., 1], 0.0).sum(axis=2)
    both = (count > 0).all(axis=1)
    left, right = (total / np.maximum(count, 1))[both].T
    return float((left > right).mean()) if len(left) else 1.0
