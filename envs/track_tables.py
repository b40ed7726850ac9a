"""What does not move around one track, worked out once: the cones near each place, and how far the boundaries are."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coil_rl.envs.track import Track

SECTORS = 12
FAR = 3.0  # m: the distances stop here, wider than any track

Corner = tuple[float, float]  # m


class Grid:
    """Square cells over each of several areas, numbered through, each named by its lower left corner.

    Args:
        lows: lower left corner of each area, [T, 2] m.
        highs: upper right corner of each area, [T, 2] m.
        cell: edge of a cell in m.
        dtype: the precision of the corners.

    Attributes:
        low: [2, T] m, the corners where the areas begin.
        last: [2, T], the last column and row of an area in which a position can be.
        columns: [T], of an area.
        offset: [T], the number of an area's first cell.
    """

    def __init__(self, lows: NDArray[np.float64], highs: NDArray[np.float64], cell: float, dtype: torch.dtype) -> None:
        self.cell = cell
        shape = np.ceil((highs - lows) / cell).astype(np.int64) + 1
        sizes = shape.prod(axis=1)
        self.low = torch.as_tensor(lows.T, dtype=dtype).double().numpy()
        self.last = shape.T - 2
        self.columns, self.offset = shape[:, 0], np.cumsum(sizes) - sizes

    def nodes(self, track: int) -> NDArray[np.float64]:
        """The lower left corners of one area's cells, [cells, 2] m, in the order of their numbers."""
        (x, y), (columns, rows) = self.low[:, track], self.last[:, track] + 2
        x, y = x + self.cell * np.arange(columns), y + self.cell * np.arange(rows)
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


class Nearby(NamedTuple):
    """The cones that matter in each cell of one track, by their numbers, ascending; -1 after the last.

    Attributes:
        used: [cells], whether any may be seen from there.
        visible: [used cells, SECTORS, 2, most], those of the left and of the right side that a car there may see.
        near: [cells, most], those close enough to count for its clearance, the right ones numbered on after the left.
    """

    used: NDArray[np.bool_]
    visible: NDArray[np.int16]
    near: NDArray[np.int16]


# A program builds the same tracks into several envs, and these two functions are the slowest part of building.
@lru_cache(maxsize=64)
def nearby(
    track: Track, low: Corner, high: Corner, cell: float, dtype: torch.dtype, sight: float, half_field_of_view: float,
    reach: float,
) -> Nearby:  # fmt: skip
    """The cones of one track within `sight` and `reach`, both in m, of each cell of an area."""
    centre = Grid(np.array([low]), np.array([high]), cell, dtype).nodes(0) + cell / 2
    # The car is somewhere in its cell and its heading somewhere in its sector.
    half_diagonal = cell * np.sqrt(0.5)
    heading = (np.arange(SECTORS) + 0.5) * 2 * np.pi / SECTORS
    rings = (track.left, track.right)
    visible = np.zeros((len(centre), SECTORS, 2, max(map(len, rings))), dtype=bool)
    touching = []
    for side, ring in enumerate(rings):
        offset = ring - centre[:, None]
        distance = np.linalg.norm(offset, axis=-1)
        touching.append(distance <= reach + half_diagonal + 1e-3)
        place, cone = np.nonzero(distance <= sight + half_diagonal + 1e-3)
        offset, distance = offset[place, cone], distance[place, cone]
        turn = np.arctan2(offset[:, 1], offset[:, 0])[:, None] - heading
        turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        slack = np.arcsin(np.minimum(1, half_diagonal / np.maximum(distance, 1e-9)))[:, None]
        ahead = (turn <= half_field_of_view + np.pi / SECTORS + slack + 1e-3) | (slack >= np.pi / 2)
        visible[place, :, side, cone] = ahead
    used = np.asarray(visible.any(axis=(1, 2, 3)))
    return Nearby(used, _columns(visible[used]), _columns(np.concatenate(touching, axis=1)))


@lru_cache(maxsize=64)
def boundary_distances(track: Track, low: Corner, high: Corner, cell: float, dtype: torch.dtype) -> NDArray[np.float64]:
    """Distance of each grid node of one track from its left and its right boundary, at most FAR: [nodes, 2] m."""
    nodes = Grid(np.array([low]), np.array([high]), cell, dtype).nodes(0)
    # A plain tree, which answers for points so dense along a line twice as fast as one that is packed and balanced.
    trees = [
        cKDTree(track.boundary(side, 0.02), compact_nodes=False, balanced_tree=False) for side in ("left", "right")
    ]
    distances = [tree.query(nodes, distance_upper_bound=FAR, workers=-1)[0] for tree in trees]
    return np.minimum(np.stack(distances, axis=1), FAR)


def _columns(mask: NDArray[np.bool_]) -> NDArray[np.int16]:
    """The places of each last row's True entries, ascending, then -1 up to the longest: [..., N] to [..., most]."""
    counts = mask.sum(axis=-1)
    columns = np.full((*mask.shape[:-1], max(1, int(counts.max()))), -1, dtype=np.int16)
    *row, column = np.nonzero(mask)
    first = np.cumsum(counts) - counts.ravel()
    columns[(*row, np.arange(len(column)) - np.repeat(first, counts.ravel()))] = column
    return columns
