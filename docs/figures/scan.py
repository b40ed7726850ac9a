"""Draw one scan of the simulated robot's LiDAR: clusters, their classes, boundaries and the guide's steering.

The robot faces up. Points closer than the perception's gap form a cluster; clusters in sight are classified as thin
(left) cones, thick (right) cones or other objects. Discs are the true cones when the beam straight ahead was sent; the
robot moves during a turn of the LiDAR. A disc without returns is hidden by a nearer cone, or nearer than the LiDAR
measures. Boundaries and guide are those of the cone world at a seventh of its size.

    python docs/figures/scan.py [OUTPUT FOLDER]
"""

from __future__ import annotations

import ego_view
import numpy as np
import torch
from ego_view import CONE_COLOURS, LINE_COLOURS, facing_up, marker, rows
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from coil_rl.envs import Perception, SimulatedDrive, simulated_cone_classifier, simulated_drive
from coil_rl.envs.robot.clusters import measure, points_of, single_linkage
from coil_rl.envs.robot.course import OUTLINE
from coil_rl.envs.robot.lidar import RANGE_MAX
from coil_rl.envs.robot.perception import BoundaryMemory
from coil_rl.envs.sight import Frame
from coil_rl.guides import SplineGuide
from coil_rl.report import style
from coil_rl.report.style import picture
from coil_rl.robot.classifier import majority

SEED = 100  # of a drive that is not in the classifier's training set
SCAN = 61  # one cluster of this scan is classified wrongly
ERROR_COLOUR = "#aa3377"


def draw_scan(axes: Axes, drive: SimulatedDrive, perception: Perception) -> None:
    """Draw the returns, the true cones and the classified clusters of the scan."""
    ranges, angles = drive.ranges[[SCAN]].numpy(), drive.angles.numpy()
    ego_view.draw_field_of_view(axes, perception.range_max, perception.bearing_max)
    pose = drive.poses[:, SCAN, int(drive.angles.abs().argmin())]
    centres = facing_up(rows(Frame(pose.unsqueeze(-1)).to_car(drive.cones)))
    for centre, radius, thick in zip(centres, drive.radius.tolist(), drive.thick.tolist(), strict=True):
        axes.add_patch(Circle(tuple(centre), radius, fc=CONE_COLOURS[thick], ec="none", alpha=0.35, zorder=2.5))

    returns = points_of(ranges, angles + perception.laser_yaw, perception.range_min, RANGE_MAX)
    axes.plot(*facing_up(np.stack([returns.x, returns.y], 1)).T, ".", ms=3, color=style.KERB, zorder=3)
    points = perception.points(ranges, angles)
    label = single_linkage(points, perception.gap)
    clusters = measure(points, label)
    kinds = perception.classifier.classify(clusters.features)
    for kind, colour in enumerate(LINE_COLOURS):
        own = np.isin(label, clusters.label[kinds == kind])
        axes.plot(*facing_up(np.stack([points.x[own], points.y[own]], 1)).T, ".", ms=5, color=colour, zorder=3.5)

    cone = majority(label, drive.hit[SCAN].numpy()[points.beam], len(drive.radius))[clusters.label]
    wrong = (cone >= 0) & (kinds != drive.thick.numpy()[cone])
    centroids = facing_up(clusters.centroid)
    axes.plot(*centroids[wrong].T, "o", ms=19, mfc="none", mec=ERROR_COLOUR, mew=1.6, zorder=9)
    distance = np.hypot(*centroids.T)
    in_sight = np.flatnonzero(perception.in_sight(clusters))
    for number, index in enumerate(in_sight[np.argsort(distance[in_sight])], 1):
        offset = centroids[index] / distance[index] * (26 if kinds[index] == 1 or wrong[index] else 16)
        style_of_text = {"ha": "center", "va": "center", "size": 8.5, "zorder": 10}
        axes.annotate(str(number), centroids[index], offset, textcoords="offset points", **style_of_text)


@torch.no_grad()
def draw_guidance(axes: Axes, drive: SimulatedDrive, perception: Perception) -> None:
    """Draw boundaries, the guide's plan and its advice, with the memory of all scans before."""
    memory, guide = BoundaryMemory(1, sight=perception.range_max * perception.scale), SplineGuide()
    ranges, angles = drive.ranges[: SCAN + 1].numpy(), drive.angles.numpy()
    steering = torch.zeros(1, 1)
    for cones, count in zip(
        *(torch.from_numpy(array).unsqueeze(1) for array in perception(ranges, angles)), strict=True
    ):
        cones = cones.float()
        _, valid = memory(cones, count)
        steering = guide.steer(cones, count, steering)
    boundary = memory.fit(cones.permute(3, 2, 1, 0), count.t())
    samples = memory.samples[..., 0].permute(2, 1, 0).double().numpy() / perception.scale
    for side in (0, 1):
        if memory.ever_valid[side, 0] > 0:
            valid_side = bool(valid[0, side])
            ego_view.draw_boundary(axes, boundary, side, valid_side, samples[side], perception.scale)
    ego_view.draw_plan(axes, guide.plan(cones, count), perception.scale)
    ego_view.draw_advice(axes, float(steering) * guide.max_steering, length=0.28)


def main() -> None:
    """Draw scan.png."""
    path = ego_view.output_folder(__doc__) / "scan.png"
    drive, perception = simulated_drive("both", SEED), Perception(simulated_cone_classifier())
    handles = [
        marker("o", "thin cone", 7, mfc=CONE_COLOURS[0], mec="none", alpha=0.35),
        marker("o", "thick cone", 12, mfc=CONE_COLOURS[1], mec="none", alpha=0.35),
        marker(".", "returns classified thin", 6, color=LINE_COLOURS[0]),
        marker(".", "returns classified thick", 6, color=LINE_COLOURS[1]),
        marker(".", "other returns", 4, color=style.KERB),
        marker("o", "wrong class", 11, mfc="none", mec=ERROR_COLOUR, mew=1.6),
        *ego_view.common_handles(),
    ]
    with picture(path, "One scan of the robot's LiDAR (simulated)", handles, height=6.4) as figure:
        axes = figure.add_subplot()
        ego_view.make_panel(axes, sideways=0.95, behind=0.2, ahead=1.08)
        axes.set_facecolor(style.ASPHALT)
        draw_scan(axes, drive, perception)
        draw_guidance(axes, drive, perception)
        length, width = OUTLINE
        axes.add_patch(
            Rectangle((-width / 2, -length / 2), width, length, fc=style.INK, ec=style.BACKGROUND, zorder=8.2)
        )
    print(path)


if __name__ == "__main__":
    main()
