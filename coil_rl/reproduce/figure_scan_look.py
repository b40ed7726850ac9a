"""One scan of a simulated robot's LiDAR: what perception makes of it, what the guide does, and what is true."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from coil_rl.envs import Perception, SimulatedDrive
from coil_rl.envs.robot.clusters import Clusters, measure, points_of, single_linkage
from coil_rl.envs.robot.lidar import RANGE_MAX
from coil_rl.envs.robot.perception import BoundaryMemory
from coil_rl.envs.sight import Frame
from coil_rl.guides import SplineGuide
from coil_rl.reproduce.facing_up import FINE, places_of, rows
from coil_rl.robot.classifier import majority

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Look:
    """A scan; places are in m in the robot's frame (x ahead, y left).

    Attributes:
        returns: of all beams, [R, 2].
        points: those near enough to be looked at, [M, 2].
        cluster: the place among the clusters of each of them, -1 for none, [M].
        clusters: C of them.
        in_sight: which the robot takes for cones, [C].
        decision: of the classifier, above 0 thick, [C].
        cone: which cone each is of, -1 for none, [C].
        truly_thick: whether that is a thick one, [C].
        visibility: share of its beams that nothing in front caught, [C].
        cones: where all cones stood when the beam straight ahead was sent, [N, 2].
        thick: which are thick, [N].
        radius: m, [N].
        estimate: the boundaries through the cones in sight, left first, [P, 2]; no point where a side is not valid.
        samples: the five of each side that the observation tells of, [2, 5, 2].
        known: whether a side was ever valid, [2].
        observation: [20].
        plan: of the guide, see `places_of`.
        advice: degrees.
    """

    returns: Array
    points: Array
    cluster: NDArray[np.int64]
    clusters: Clusters
    in_sight: Flags
    decision: Array
    cone: NDArray[np.int64]
    truly_thick: Flags
    visibility: Array
    cones: Array
    thick: Flags
    radius: Array
    estimate: Sequence[Array]
    samples: Array
    known: Flags
    observation: Array
    plan: Mapping[str, Array]
    advice: float

    @property
    def wrong(self) -> Flags:
        """Which clusters of a cone are taken for the other kind, [C]."""
        return (self.cone >= 0) & ((self.decision > 0) != self.truly_thick)


@torch.no_grad()
def look(drive: SimulatedDrive, scan: int, perception: Perception) -> Look:
    """Look at a scan of a drive; what is remembered of the boundaries is of the scans before.

    Args:
        drive: past both sides.
        scan: its number, from 0.
        perception: of the robot.
    """
    ranges, angles = drive.ranges[: scan + 1].numpy(), drive.angles.numpy()
    points = perception.points(ranges[-1:], angles)
    label = single_linkage(points, perception.gap)
    clusters = measure(points, label)
    hit = drive.hit[scan].numpy()[points.beam]
    cone = majority(label, hit, len(drive.radius))[clusters.label]
    place = np.full(label.max(initial=-1) + 1, -1)
    place[clusters.label] = np.arange(len(clusters.label))
    everywhere = points_of(ranges[-1:], angles + perception.laser_yaw, perception.range_min, RANGE_MAX)

    memory, guide = BoundaryMemory(1, sight=perception.range_max * perception.scale), SplineGuide()
    found, number = (torch.from_numpy(x) for x in perception(ranges, angles))
    steering = torch.zeros(1, 1)
    for seen, count in zip(found.float().unsqueeze(1), number.unsqueeze(1), strict=True):
        observation, valid = memory(seen, count)
        steering = guide.steer(seen, count, steering)
    boundary = memory.fit(seen.permute(3, 2, 1, 0), count.t()).equidistant(FINE) / perception.scale
    pose = drive.poses[:, scan, int(drive.angles.abs().argmin())]
    return Look(
        returns=np.stack([everywhere.x, everywhere.y], 1),
        points=np.stack([points.x, points.y], 1),
        cluster=place[label],
        clusters=clusters,
        in_sight=perception.in_sight(clusters),
        decision=perception.classifier.decision(clusters.features),
        cone=cone,
        truly_thick=drive.thick.numpy()[cone] & (cone >= 0),
        visibility=np.where(cone >= 0, drive.visibility[scan].numpy()[cone], np.nan),
        cones=rows(Frame(pose.unsqueeze(-1)).to_car(drive.cones)),
        thick=drive.thick.numpy(),
        radius=drive.radius.double().numpy(),
        estimate=[rows(boundary[:, : FINE if valid[0, side] else 0, side, 0]) for side in (0, 1)],
        samples=memory.samples[..., 0].permute(2, 1, 0).double().numpy() / perception.scale,
        known=memory.ever_valid[:, 0].numpy() > 0,
        observation=observation[0].double().numpy(),
        plan=places_of(guide.plan(seen, count), perception.scale),
        advice=float(steering) * guide.max_steering,
    )
