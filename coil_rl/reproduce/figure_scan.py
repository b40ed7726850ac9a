"""One scan of the robot's LiDAR (section 4.2, appendix A.3), simulated: its clusters, their classes, the steering."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs import Perception, simulated_cone_classifier, simulated_drive
from coil_rl.envs.robot.clusters import FEATURES
from coil_rl.envs.robot.drives import TEST_SEED
from coil_rl.envs.robot.lidar import RANGE_MIN
from coil_rl.envs.track import SIDES
from coil_rl.report import markdown_table, write_csv
from coil_rl.reproduce.facing_up import rows_of_places, rows_of_samples
from coil_rl.reproduce.figure_scan_look import Look, look
from coil_rl.reproduce.figure_scan_picture import draw
from coil_rl.reproduce.result import NO_RUNS, Result, Runs
from coil_rl.robot.classifier import accuracy, label_clusters

KINDS = ("thin", "thick")

COLUMNS = {
    "number": ("cluster", "d"),
    "size": ("points", "d"),
    "range": ("range (m)", ".2f"),
    "bearing": ("bearing (deg)", ".0f"),
    "width": ("width (m)", ".3f"),
    "depth": ("depth (m)", ".3f"),
    "girth": ("girth (m)", ".3f"),
    "decision": ("decision", ".2f"),
    "called": ("called", ""),
    "truly": ("truly", ""),
    "visible": ("visible", ".0%"),
}


class FigureScan(Result):
    """A scan of a simulated drive along the middle of the robot's track, which the classifier did not learn from.

    Args:
        seed: of the drive.
        scan: its number in the drive, from 0.

    Raises:
        ValueError: for a seed of a drive that the classifier learned from, or a scan that the drive does not have.
    """

    def __init__(self, seed: int = TEST_SEED, scan: int = 61) -> None:
        if seed < TEST_SEED:
            raise ValueError(f"seed={seed} must be at least {TEST_SEED}: the classifier learns from drives before that")
        self.drive = simulated_drive("both", seed)
        if not 0 <= scan < len(self.drive.ranges):
            raise ValueError(f"scan={scan} must be 0 to {len(self.drive.ranges) - 1}, the scans of the drive")
        self.scan = scan
        self.perception = Perception(simulated_cone_classifier())

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        found = look(self.drive, self.scan, self.perception)
        numbers = _numbers(found)
        clusters = list(_clusters(found, numbers))
        write_csv([*clusters, *_places(found, numbers)], stem.with_suffix(".csv"))
        title = "What the robot makes of one scan of its LiDAR (simulated)"
        draw(found, numbers, self.perception, stem.with_suffix(".png"), title)
        return self._page(found, clusters)

    def _page(self, found: Look, clusters: list[dict[str, object]]) -> str:
        seen = [row for row in clusters if row["in sight"]]
        wrong = [str(row["number"]) for row in seen if row["called"] != row["truly"] and row["truly"] in KINDS]
        share = accuracy(self.perception.classifier, label_clusters([self.drive]))["all"]
        of = f"{found.wrong[found.in_sight].sum()} of {len(seen)}"
        told = f"{of} in sight are taken for the other kind ({', '.join(wrong)})" if wrong else "all are told right"
        sight, margin, gap = self.perception.range_max, self.perception.margin, self.perception.gap
        degrees = f"{abs(found.advice):.0f}° to the {SIDES[int(found.advice < 0)]}"
        return "\n\n".join(
            [
                "## One scan of the robot's LiDAR (simulated)",
                f"Scan {self.scan} of a simulated drive: {len(found.returns)} of {self.drive.ranges.shape[1]} beams "
                f"come back, {len(found.points)} of them from within {sight + margin:g} m. Points closer than "
                f"{100 * gap:g} cm are one cluster; there are {len(clusters)} of at least two points, {len(seen)} of "
                f"them in sight (the mean of their points within {sight:g} m and "
                f"{np.degrees(self.perception.bearing_max):.0f}° to either side). These the robot takes for cones:",
                markdown_table(seen, COLUMNS),
                "Width is the distance from the first point to the last, depth the difference of the least and the "
                "greatest range, girth the length of the line through all points; the classifier's decision is above 0 "
                "for thick cones. Visible is the share of the cone's beams that no nearer cone catches. Here "
                f"{told}; in the whole drive the classifier is right about {share.correct} of {share.total} clusters "
                f"within 1 m ({share.share:.1%}). Boundaries, observation and guide are those of the cone world, at a "
                f"seventh of its size: the guide steers {degrees}.",
                "Filled circles are where the cones stood when the beam straight ahead was sent; the robot drives on "
                "while the LiDAR turns. One without returns is as a rule hidden by a nearer one, or nearer than "
                f"{RANGE_MIN} m, where the LiDAR measures nothing.",
            ]
        )


def _numbers(found: Look) -> NDArray[np.int64]:
    """What clusters are called, [C]: from 1, those in sight before the others, and nearest first."""
    order = np.lexsort((np.hypot(*found.clusters.centroid.T), ~found.in_sight))
    return np.argsort(order) + 1


def _clusters(found: Look, numbers: NDArray[np.int64]) -> Iterator[dict[str, object]]:
    for place in np.argsort(numbers):
        x, y = found.clusters.centroid[place]
        yield {
            "part": "cluster",
            "number": numbers[place],
            "x": x,
            "y": y,
            "size": found.clusters.size[place],
            "range": np.hypot(x, y),
            "bearing": np.degrees(np.arctan2(y, x)),
            **dict(zip(FEATURES, found.clusters.features[place], strict=True)),
            "decision": found.decision[place],
            "called": KINDS[int(found.decision[place] > 0)],
            "truly": KINDS[int(found.truly_thick[place])] if found.cone[place] >= 0 else "no cone",
            "visible": found.visibility[place],
            "in sight": bool(found.in_sight[place]),
        }


def _places(found: Look, numbers: NDArray[np.int64]) -> Iterator[dict[str, object]]:
    yield {"part": "advice", "degrees": found.advice}
    yield from rows_of_samples(found.samples, found.observation)
    for (x, y), cluster in zip(found.points, found.cluster, strict=True):
        yield {"part": "point", "x": x, "y": y, "number": numbers[cluster] if cluster >= 0 else None}
    places = {f"boundary {side}": curve for side, curve in zip(SIDES, found.estimate, strict=True)} | dict(found.plan)
    places |= {f"{kind} cone": found.cones[found.thick == bool(thick)] for thick, kind in enumerate(KINDS)}
    yield from rows_of_places(places)
