"""Lookup tables of tracks: candidate cones for sight, and the distance to a crash.

All static geometry is computed once: for each square metre and each of 12 heading sectors the cones
that may be visible, and on a fine grid the distance to each boundary. A step of thousands of cars
then reads a few numbers per car.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from coil_rl.envs.constants import constant
from coil_rl.envs.kept_tables import Tables, kept
from coil_rl.envs.sight import HALF_FIELD_OF_VIEW, SIGHT
from coil_rl.envs.splines import slots_in_use
from coil_rl.envs.track import SIDES, Track

CONE_RADIUS = 0.4  # m, crash distance between a car's centre and a cone
BOUNDARY_MARGIN = 0.25  # m, crash distance between a car's centre and a boundary
EXACT = 1.0  # m, clearances up to this include all cones
SECTORS = 12  # of headings, 30 degrees each
MAX_DISTANCE = 3.0  # m, limit of the distance field, wider than any track
CELL = 1.0  # m, edge of a cell of candidate cones
FIELD_CELL = 0.1  # m, edge of a cell of the distance field; the interpolation error is below 2 mm
MARGIN = 2.0  # m, around the cones and the start
FAR = 1e4  # m, coordinates of padding

Numbers = NDArray[np.int16]


class Location(NamedTuple):
    """The positions of cars in the tables of a `TrackMap`.

    Attributes:
        track: [B], index of the car's track.
        position: [2, B] m.
        finish: [2, B] m, the middle of the finish line of the car's track.
        cell: [B], the cell of candidate cones.
        nodes: [2, B], the lower left and the upper left node of the distance field.
        fraction: [2, B], place between the nodes, from 0 at the lower left one to 1 at the upper
            right one.
    """

    track: Tensor
    position: Tensor
    finish: Tensor
    cell: Tensor
    nodes: Tensor
    fraction: Tensor


class TrackMap(nn.Module):
    """The static geometry of several tracks on one device.

    A batch of cars refers to the tracks by index. All tables are buffers that are not saved, as
    they follow from the tracks.

    Args:
        tracks: at least one, else a `ValueError`.
        sight: m, range of view of the cars.
        dtype: of positions and distances.
    """

    cones: Tensor  # [2, slots of all sides of all tracks] m
    # A block holds the candidates of one cell in all sectors; cells without candidates share block
    # 0.
    block: Tensor  # [cells]
    candidate: Tensor  # [blocks * SECTORS, most * 2], slots
    candidate_count: Tensor  # [blocks * SECTORS], of the side with more candidates
    near: Tensor  # [cells, N], slots of the cones that may decide the clearance
    field: Tensor  # [nodes * 2] m, distances to the left and the right boundary
    points: Tensor  # [8, tracks]: finish and low corner in m, last cell and last node
    counts: Tensor  # [4, tracks]: columns and first number of the cells, and of the nodes

    def __init__(
        self, tracks: Sequence[Track], *, sight: float = SIGHT, dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__()
        if not tracks:
            raise ValueError("a track map needs at least one track, none was given")
        self.tracks = list(tracks)
        for name, table in _tables(tuple(tracks), sight, dtype).items():
            self.register_buffer(name, table, persistent=False)
        self.slots = self.cones.shape[1] // (2 * len(tracks))
        self.most = self.candidate.shape[1] // 2

    def locate(self, track: Tensor, position: Tensor) -> Location:
        """Locate positions [2, B] m on tracks [B]; positions off the map are moved to its edge."""
        points = self.points.index_select(1, track).view(4, 2, -1)
        finish, low, last = points[0], points[1], points[2:]
        columns, offset = self.counts.index_select(1, track).view(2, 2, -1).unbind(0)
        at = (position - low).unsqueeze(0)
        at = at / constant((CELL, FIELD_CELL), at)
        corner = torch.minimum(at.floor().clamp_(min=0), last)
        column, row = corner.long().unbind(1)
        cell, node = torch.addcmul(offset + column, row, columns).unbind(0)
        fraction = (at[1] - corner[1]).clamp_(0, 1)
        nodes = torch.stack([node, node + columns[1]])
        return Location(track.int(), position, finish, cell, nodes, fraction)

    def candidates(self, location: Location, heading: Tensor) -> tuple[Tensor, Tensor]:
        """Return a superset of the cones visible to cars with headings [B], in radians.

        Returns:
            Slot of each candidate among its track's cones [N, 2, B], ascending, the right side from
            `slots` on, and its position [2, N, 2, B] in m; padding is 10 km away.
        """
        sector = (heading * constant(SECTORS / (2 * np.pi), heading)).floor_()
        sector = sector.remainder_(constant(SECTORS, heading))
        row = torch.add(sector.long(), self.block.index_select(0, location.cell), alpha=SECTORS)
        most = slots_in_use(self.candidate_count.index_select(0, row), self.most)
        slot = _batch_last(self.candidate.index_select(0, row)[:, : 2 * most]).view(most, 2, -1)
        return slot, self._positions(location.track, slot)

    def to_boundaries(self, location: Location) -> Tensor:
        """Return the distances to the left and the right boundary: [2, B] m, at most 3."""
        nodes = location.nodes.unsqueeze(0)
        # The two distances of a node are followed by those of the node to its right.
        index = torch.add(constant(range(4), nodes), nodes, alpha=2).flatten()
        left, right = self.field.index_select(0, index).view(2, 2, 2, -1).unbind(0)
        low, high = torch.lerp(left, right, location.fraction[0]).unbind(1)
        # The sides are interpolated separately, because the minimum of both has a kink in the
        # middle of the track.
        return torch.lerp(low, high, location.fraction[1])

    def clearance(self, location: Location, to_boundaries: Tensor) -> Tensor:
        """Return the distance to a crash [B] in m; zero or less is a crash.

        Exact up to 1 m; beyond that, cones may be missing from the table.
        """
        slot = _batch_last(self.near.index_select(0, location.cell))
        cones = self._positions(location.track, slot)
        to_cone = (cones - location.position.unsqueeze(1)).square_().sum(0).amin(0).sqrt_()
        nearer = to_boundaries.amin(0)
        return torch.minimum(
            to_cone - constant(CONE_RADIUS, to_cone), nearer - constant(BOUNDARY_MARGIN, nearer)
        )

    def _positions(self, track: Tensor, slot: Tensor) -> Tensor:
        """Return the positions [2, *slots, B] m of cones by their slots on tracks [B]."""
        index = torch.add(slot, track, alpha=2 * self.slots).flatten()
        return self.cones.index_select(1, index).view(2, *slot.shape)


class Grid:
    """Square cells over the area of a track, numbered row by row from the corner `low` on.

    Args:
        track: the track.
        cell: m, edge of a cell.
        dtype: to which the corner is rounded, so that all tables have the same one.
    """

    def __init__(self, track: Track, cell: float, dtype: torch.dtype) -> None:
        points = np.vstack([track.left, track.right, [track.start[:2]]])
        low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
        self.cell, self.shape = cell, np.ceil((high - low) / cell).astype(np.int64) + 1
        self.low = torch.as_tensor(low, dtype=dtype).double().numpy()

    def nodes(self) -> NDArray[np.float64]:
        """Return the lower left corners of the cells, [cells, 2] m."""
        x = self.low[0] + self.cell * np.arange(self.shape[0])
        y = self.low[1] + self.cell * np.arange(self.shape[1])
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


# Cached and shared, because programs build several envs with the same tracks, which takes seconds
# for a hundred; and kept for the next program.
@lru_cache(maxsize=8)
def _tables(tracks: tuple[Track, ...], sight: float, dtype: torch.dtype) -> Tables:
    """Return the buffers of a `TrackMap` by name."""
    make = partial(_computed_tables, tracks, sight, dtype)
    return kept("tracks", _source(tracks, sight, dtype), make)


def _source(tracks: Sequence[Track], sight: float, dtype: torch.dtype) -> Iterator[bytes]:
    """Yield everything that the buffers follow from, this program included."""
    folder = Path(__file__).parent
    for file in ("track_map.py", "track.py", "sight.py"):
        yield (folder / file).read_bytes()
    yield f"{np.__version__} {scipy.__version__} {sight} {dtype}".encode()
    for track in tracks:
        for array in (track.left, track.right, np.array(track.start)):
            yield array.tobytes()


def _computed_tables(
    tracks: Sequence[Track], sight: float, dtype: torch.dtype
) -> dict[str, Tensor]:
    cones = _cone_table(tracks)
    slots = cones.shape[-1]
    used, visible, near = zip(*(nearby_cones(track, sight, dtype) for track in tracks), strict=True)
    filled = np.concatenate(used)
    candidate = _stack([np.full((1, SECTORS, 2, 1), -1), *visible])
    slot = np.where(candidate < 0, slots - 1, candidate) + np.array([[0], [slots]])
    # The right cones of a track are numbered after its left ones; their slots begin at `slots`.
    decisive = _stack(
        [
            np.where(cone < len(track.left), cone, cone - len(track.left) + slots)
            for cone, track in zip(near, tracks, strict=True)
        ]
    )

    points, counts = _grid_numbers(tracks, dtype)
    field = np.concatenate([boundary_distances(track, dtype) for track in tracks])
    numbers: dict[str, tuple[NDArray[np.generic], torch.dtype]] = {
        "cones": (cones.reshape(2, -1), dtype),
        "block": (np.where(filled, filled.cumsum(), 0), torch.int64),
        "candidate": (slot.swapaxes(-1, -2).reshape(-1, 2 * candidate.shape[-1]), torch.int16),
        "candidate_count": ((candidate >= 0).sum(-1).max(-1).ravel(), torch.int16),
        "near": (np.where(decisive < 0, slots - 1, decisive), torch.int32),
        "field": (field.ravel(), dtype),
        "points": (points, dtype),
        "counts": (counts, torch.int64),
    }
    return {
        name: torch.tensor(np.ascontiguousarray(table), dtype=kind)
        for name, (table, kind) in numbers.items()
    }


def _cone_table(tracks: Sequence[Track]) -> NDArray[np.float64]:
    """Return the cones of all tracks, [2, tracks, 2, slots] m, padded by cones far away.

    Each side has at least one slot of padding, the last one.
    """
    slots = max(max(len(track.left), len(track.right)) for track in tracks) + 1
    cones = np.full((2, len(tracks), 2, slots), FAR)
    for index, track in enumerate(tracks):
        for side, ring in enumerate((track.left, track.right)):
            cones[:, index, side, : len(ring)] = ring.T
    return cones


def _grid_numbers(
    tracks: Sequence[Track], dtype: torch.dtype
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the numbers that locate a position in the two grids, one column per track.

    Returns:
        `points` and `counts` of a `TrackMap`, [8, tracks] and [4, tracks].
    """
    grids = [[Grid(track, edge, dtype) for track in tracks] for edge in (CELL, FIELD_CELL)]
    finish = np.stack([track.finish for track in tracks], axis=1)
    low = np.stack([grid.low for grid in grids[0]], axis=1)
    shapes = [np.array([grid.shape for grid in row]).T for row in grids]
    offsets = [np.cumsum(shape.prod(axis=0)) - shape.prod(axis=0) for shape in shapes]
    points = np.vstack([finish, low, *[shape - 2 for shape in shapes]])
    return points, np.stack([*[shape[0] for shape in shapes], *offsets])


# Cached, because some sets of tracks have tracks in common.
@lru_cache(maxsize=64)
def nearby_cones(
    track: Track, sight: float, dtype: torch.dtype
) -> tuple[NDArray[np.bool_], Numbers, Numbers]:
    """Return which cones of a track matter to a car in each cell.

    A row of cones holds their numbers, ascending, and ends with -1 where another row is longer.

    Args:
        sight: m, range of view.

    Returns:
        Whether any cone may be visible, [cells]; the cones of the left and of the right side that
        may be visible, [cells with any, SECTORS, 2, most]; and the cones that may decide the
        clearance, the right ones numbered after the left ones, [cells, most].
    """
    centre = Grid(track, CELL, dtype).nodes() + CELL / 2
    # The car is anywhere in its cell, its heading anywhere in its sector.
    half_diagonal = CELL * np.sqrt(0.5)
    heading = (np.arange(SECTORS) + 0.5) * 2 * np.pi / SECTORS
    rings = (track.left, track.right)
    visible = np.zeros((len(centre), SECTORS, 2, max(map(len, rings))), dtype=bool)
    near = []
    for side, ring in enumerate(rings):
        offset = ring - centre[:, None]
        distance = np.linalg.norm(offset, axis=-1)
        near.append(distance <= CONE_RADIUS + EXACT + half_diagonal + 1e-3)
        cell, cone = np.nonzero(distance <= sight + half_diagonal + 1e-3)
        offset, distance = offset[cell, cone], distance[cell, cone]
        bearing = np.arctan2(offset[:, 1], offset[:, 0])[:, None] - heading
        bearing = np.abs((bearing + np.pi) % (2 * np.pi) - np.pi)
        slack = np.arcsin(np.minimum(1, half_diagonal / np.maximum(distance, 1e-9)))[:, None]
        ahead = (bearing <= HALF_FIELD_OF_VIEW + np.pi / SECTORS + slack + 1e-3) | (
            slack >= np.pi / 2
        )
        visible[cell, :, side, cone] = ahead
    used = np.asarray(visible.any(axis=(1, 2, 3)))
    return used, _true_columns(visible[used]), _true_columns(np.concatenate(near, axis=1))


@lru_cache(maxsize=64)
def boundary_distances(track: Track, dtype: torch.dtype) -> NDArray[np.float64]:
    """Return the distances of the grid nodes from both boundaries: [nodes, 2] m, at most 3."""
    from scipy.spatial import cKDTree  # only tables that are not kept yet need it

    nodes = Grid(track, FIELD_CELL, dtype).nodes()
    distances = []
    for side in SIDES:
        # For points this dense along a line, a plain tree is twice as fast as a compact and
        # balanced one.
        boundary = track.boundary(side, 0.02)
        tree = cKDTree(boundary, compact_nodes=False, balanced_tree=False)
        distances.append(tree.query(nodes, distance_upper_bound=MAX_DISTANCE, workers=-1)[0])
    return np.minimum(np.stack(distances, axis=1), MAX_DISTANCE)


def _true_columns(mask: NDArray[np.bool_]) -> Numbers:
    """Return the columns of the True entries of each row [..., N]: [..., most].

    They are ascending and padded with -1 to the length of the longest row.
    """
    counts = mask.sum(axis=-1)
    columns = np.full((*mask.shape[:-1], max(1, int(counts.max()))), -1, dtype=np.int16)
    *row, column = np.nonzero(mask)
    first = np.cumsum(counts) - counts.ravel()
    columns[(*row, np.arange(len(column)) - np.repeat(first, counts.ravel()))] = column
    return columns


def _batch_last(rows: Tensor) -> Tensor:
    """Transpose small integers [B, N] to int32 [N, B]."""
    return rows.t().to(torch.int32, memory_format=torch.contiguous_format)


def _stack(tables: Sequence[NDArray[np.integer]]) -> NDArray[np.integer]:
    """Concatenate tables [rows, ..., N], the narrower ones filled up with -1."""
    most = max(table.shape[-1] for table in tables)
    filled = []
    for table in tables:
        ends = [(0, 0)] * (table.ndim - 1) + [(0, most - table.shape[-1])]
        filled.append(np.pad(table, ends, constant_values=-1))
    return np.concatenate(filled)
