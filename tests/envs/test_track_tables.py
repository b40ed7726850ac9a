import numpy as np
import torch
from scipy.spatial import cKDTree

from coil_rl.envs import Track
from coil_rl.envs.track_tables import FAR, Grid, boundary_distances, nearby

LOW, HIGH = (-9.0, -9.0), (9.0, 9.0)


def places(cell: float) -> np.ndarray:
    return Grid(np.array([LOW]), np.array([HIGH]), cell, torch.float64).nodes(0)


def test_near_cones_are_the_ones_within_reach_of_a_cell_left_before_right(ring: Track) -> None:
    _, _, near = nearby(ring, LOW, HIGH, 1.0, torch.float64, 7.0, 1.0, 1.4)
    cones = np.vstack([ring.left, ring.right])
    for centre, listed in zip(places(1.0) + 0.5, near, strict=True):
        within = np.linalg.norm(cones - centre, axis=1) <= 1.4 + np.sqrt(0.5) + 1e-3
        assert listed[listed >= 0].tolist() == np.flatnonzero(within).tolist()


def test_distances_are_those_of_the_nearest_points_of_each_boundary(ring: Track) -> None:
    found = boundary_distances(ring, LOW, HIGH, 0.1, torch.float64)
    for side, distance in zip(("left", "right"), found.T, strict=True):
        truth = cKDTree(ring.boundary(side, 0.02)).query(places(0.1))[0]
        np.testing.assert_array_equal(distance, truth.clip(max=FAR))


def test_what_was_worked_out_is_not_worked_out_again(ring: Track) -> None:
    for table, more in ((nearby, (7.0, 1.0, 1.4)), (boundary_distances, ())):
        assert table(ring, LOW, HIGH, 1.0, torch.float32, *more) is table(ring, LOW, HIGH, 1.0, torch.float32, *more)
