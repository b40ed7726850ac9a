"""Exact clustering on every scan of the real recordings, which lie beside the repository, not in it."""

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from coil_rl.envs.robot.clusters import GAP, measure, points_of, single_linkage

RECORDINGS = Path(__file__).resolve().parents[4] / "shared" / "recordings"
# Clusters within 1.15 m, and of those the ones of at least two points, over all scans of a topic.
COUNTS = {
    ("breezyslam_exp1_urg_odom", "/scan"): (756, 3241, 2817),
    ("rplidar_c1_lab446a", "/scan"): (10, 81, 81),
    ("urg04lx_obstacle_detector_demo", "/rear_scan"): (330, 1955, 1926),
    ("urg04lx_obstacle_detector_demo", "/scan"): (331, 722, 719),
    ("urg_legs_positive_7", "/scan"): (510, 1247, 1229),
}


def read(path: Path, topic: str):
    """Ranges [N, P], bearings [P] and least range of a topic of LaserScan, little-endian CDR."""
    reader = pytest.importorskip("mcap.reader")
    ranges = []
    with path.open("rb") as file:
        for _, _, message in reader.make_reader(file, validate_crcs=True).iter_messages(topics=[topic]):
            frame = struct.unpack_from("<I", message.data, 12)[0]
            at = 4 + (12 + frame + 3) // 4 * 4
            first, _, step, _, _, least, _, beams = struct.unpack_from("<7fI", message.data, at)
            ranges.append(np.frombuffer(message.data, "<f4", beams, at + 32))
    return np.array(ranges), first + step * np.arange(beams), least


@pytest.mark.parametrize(("name", "topic"), COUNTS)
def test_clusters_are_the_components_of_all_distances_on_every_recorded_scan(name, topic):
    path = RECORDINGS / f"{name}.mcap"
    if not path.exists():
        pytest.skip(f"{path} is not here")
    ranges, angles, least = read(path, topic)
    points = points_of(ranges, angles, least, 1.15)
    label = single_linkage(points)
    clusters = measure(points, label)
    for scan in range(len(ranges)):
        here = points.scan == scan
        place = np.stack([points.x[here], points.y[here]], axis=1)
        count, component = connected_components(cdist(place, place, "sqeuclidean") < GAP * GAP)
        assert len(set(zip(component.tolist(), label[here].tolist(), strict=True))) == count
        assert len(np.unique(label[here])) == count
    assert (len(ranges), int(label.max()) + 1, len(clusters.size)) == COUNTS[name, topic]
    assert np.isfinite(clusters.features).all()
    assert (clusters.features >= 0).all()
    # A line is at least as long as from end to end, which allows for rounding.
    assert (clusters.features[:, 2] - clusters.features[:, 0] > -1e-12).all()
