"""Tracks as lookup tables: what a car at a pose could see, and how far it is from a crash.

A step of thousands of cars cannot look at every cone of their tracks. Everything that does not move is therefore
worked out once: for each square metre and each twelfth of a turn the cones that a car there may see, and on a fine grid
the distance to the nearest boundary. A step then reads a few numbers per car.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn

from coil_rl.envs.splines import slots_in_use
from coil_rl.envs.track import Track

SECTORS = 12
FAR = 3.0  # m: the distance field stops here, wider than any track
EXACT = 1.0  # m: a clearance up to this counts every cone, a larger one perhaps only the boundaries


class Grid(nn.Module):
    """Square cells over each of several areas, numbered through, with one number looked up per cell.

    Args:
        lows: lower left corner of each area, [T, 2] m.
        highs: upper right corner of each area, [T, 2] m.
        cell: edge of a cell in m.
    """

    low: Tensor
    last: Tensor
    columns: Tensor
    offset: Tensor

    def __init__(self, lows: NDArray[np.float64], highs: NDArray[np.float64], cell: float, dtype: torch.dtype) -> None:
        super().__init__()
        self.cell = cell
        shape = np.ceil((highs - lows) / cell).astype(np.int64) + 1
        sizes = shape.prod(axis=1)
        self.register_buffer("low", torch.as_tensor(lows.T.copy(), dtype=dtype), persistent=False)
        self.register_buffer("last", torch.as_tensor(shape.T - 2, dtype=dtype), persistent=False)
        self.register_buffer("columns", torch.as_tensor(shape[:, 0]), persistent=False)
        self.register_buffer("offset", torch.as_tensor(np.cumsum(sizes) - sizes), persistent=False)

    def nodes(self, track: int) -> NDArray[np.float64]:
        """The lower left corners of one area's cells, [cells, 2] m, in the order of their numbers."""
        low = self.low[:, track].double().numpy()
        columns, rows = (int(last) + 2 for last in self.last[:, track])
        x, y = low[0] + self.cell * np.arange(columns), low[1] + self.cell * np.arange(rows)
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def locate(self, track: Tensor, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Number of the cell, its area's columns, and where in the cell ([2, B], 0 to 1) each position [2, B] lies.

        A position outside its area counts as the nearest cell.
        """
        at = (position - self.low.index_select(1, track)) / self.cell
        corner = torch.minimum(at.floor().clamp_(min=0), self.last.index_select(1, track))
        column, row = corner.long().unbind(0)
        columns = self.columns.index_select(0, track)
        number = torch.addcmul(self.offset.index_select(0, track) + column, row, columns)
        return number, columns, (at - corner).clamp_(0, 1)


class TrackMap(nn.Module):
    """The static geometry of several tracks, on one device, for a batch of cars.

    Args:
        tracks: the tracks; a car names its own by its place in this list.
        sight: how far a car sees, in m.
        half_field_of_view: how far to either side of its heading it sees, in radians.
        cone_radius: a car's centre this close to a cone has crashed, in m.
        boundary_margin: a car's centre this close to a boundary has crashed, in m.
        cell: edge of the cells that hold candidate cones, in m.
        field_cell: edge of the cells of the distance field, in m. Interpolation between its nodes is off by less than
            field_cell^2 / 4 times the boundary's curvature: 2 mm at the tightest bends.
        dtype: of all coordinates.
    """

    cones: Tensor
    finish: Tensor
    starts: Tensor
    candidate: Tensor
    listed: Tensor
    block: Tensor
    near: Tensor
    field: Tensor

    def __init__(
        self,
        tracks: Sequence[Track],
        *,
        sight: float = 7.0,
        half_field_of_view: float = float(np.deg2rad(60)),
        cone_radius: float = 0.4,
        boundary_margin: float = 0.25,
        cell: float = 1.0,
        field_cell: float = 0.1,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        if not tracks:
            raise ValueError("a track map needs at least one track, none was given")
        self.names = [track.name for track in tracks]
        self.cone_radius, self.boundary_margin = cone_radius, boundary_margin
        rings = [(track.left, track.right) for track in tracks]
        everything = [np.vstack([*pair, [track.start[:2]]]) for pair, track in zip(rings, tracks, strict=True)]
        lows = np.stack([points.min(axis=0) for points in everything]) - 2
        highs = np.stack([points.max(axis=0) for points in everything]) + 2

        self.slots = max(len(ring) for pair in rings for ring in pair) + 1
        cones = np.full((2, len(tracks), 2, self.slots), 1e4)
        for index, pair in enumerate(rings):
            for side, ring in enumerate(pair):
                cones[:, index, side, : len(ring)] = ring.T
        self._keep("cones", cones.reshape(2, -1), dtype)
        self._keep("finish", np.stack([track.finish for track in tracks], axis=1), dtype)
        self._keep("starts", np.array([track.start for track in tracks]).T, dtype)

        self.cells = Grid(lows, highs, cell, dtype)
        self._list_candidates(rings, sight, half_field_of_view)
        self.fine = Grid(lows, highs, field_cell, dtype)
        field = [
            _boundary_distances(track, tuple(lows[index].tolist()), tuple(highs[index].tolist()), field_cell, dtype)
            for index, track in enumerate(tracks)
        ]
        self._keep("field", np.concatenate(field), dtype)

    def __len__(self) -> int:
        return len(self.names)

    def _keep(self, name: str, values: NDArray[np.generic], dtype: torch.dtype) -> None:
        self.register_buffer(name, torch.as_tensor(np.ascontiguousarray(values), dtype=dtype), persistent=False)

    def _list_candidates(
        self, rings: list[tuple[NDArray[np.float64], NDArray[np.float64]]], sight: float, half_field_of_view: float
    ) -> None:
        """Fill `candidate` [blocks * SECTORS, 2 * most], `listed`, `block` (its block for each cell) and `near`.

        `listed` says how many candidates the side that has more of them really has.
        """
        half_diagonal = self.cells.cell * np.sqrt(0.5)
        heading = (np.arange(SECTORS) + 0.5) * 2 * np.pi / SECTORS
        padding = np.array([[self.slots - 1], [2 * self.slots - 1]])
        seen, blocks, nears = [padding * np.ones((SECTORS, 1, 1), dtype=np.int64)], [], []
        filled = 1
        for index, pair in enumerate(rings):
            centre = self.cells.nodes(index) + self.cells.cell / 2
            visible = np.zeros((len(centre), SECTORS, 2, self.slots), dtype=bool)
            touching = np.zeros((len(centre), 2, self.slots), dtype=bool)
            for side, ring in enumerate(pair):
                offset = ring - centre[:, None]
                distance = np.linalg.norm(offset, axis=-1)
                turn = np.arctan2(offset[..., 1], offset[..., 0])[:, None] - heading[:, None]
                turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
                # The car is somewhere in its cell and its heading somewhere in its sector.
                slack = np.arcsin(np.minimum(1, half_diagonal / np.maximum(distance, 1e-9)))[:, None]
                ahead = (turn <= half_field_of_view + np.pi / SECTORS + slack + 1e-3) | (slack >= np.pi / 2)
                within = distance <= sight + half_diagonal + 1e-3
                visible[:, :, side, : len(ring)] = within[:, None] & ahead
                touching[:, side, : len(ring)] = distance <= self.cone_radius + EXACT + half_diagonal + 1e-3
            used = visible.any(axis=(1, 2, 3))
            blocks.append(np.where(used, filled + np.cumsum(used) - 1, 0))
            filled += int(used.sum())
            places = _columns(visible[used], self.slots - 1) + np.array([[0], [self.slots]])
            seen.append(places.reshape(-1, 2, places.shape[-1]))
            nears.append(_columns(touching.reshape(len(centre), -1), self.slots - 1))
        candidate = _stack(seen, padding)
        self.most = candidate.shape[-1]
        self._keep("candidate", candidate.reshape(-1, 2 * self.most), torch.int16)
        self._keep("listed", (candidate != padding).sum(-1).max(-1).reshape(-1), torch.int16)
        self._keep("block", np.concatenate(blocks), torch.int64)
        self._keep("near", _stack(nears, np.array([self.slots - 1])), torch.int32)

    def cell(self, track: Tensor, position: Tensor) -> Tensor:
        """The cell [B] in which a car of these tracks [B] at this position [2, B] m is."""
        return self.cells.locate(track, position)[0]

    def candidates(self, track: Tensor, cell: Tensor, heading: Tensor) -> tuple[Tensor, Tensor]:
        """The cones a car may see, never fewer than it does.

        Args:
            track: [B], the car's track.
            cell: [B], where it is.
            heading: [B], radians.

        Returns:
            Slot of each candidate among its track's cones [N, 2, B] (left then right, rings padded to `slots`),
            ascending, and its position [2, N, 2, B] in m; padding lies 10 km away.
        """
        sector = (heading * (SECTORS / (2 * np.pi))).floor_().remainder_(SECTORS).long()
        row = torch.add(sector, self.block.index_select(0, cell), alpha=SECTORS)
        most = slots_in_use(self.listed.index_select(0, row), self.most)
        slot = self.candidate.index_select(0, row).view(-1, 2, self.most)[..., :most]
        slot = slot.permute(2, 1, 0).contiguous().int()
        return slot, self._positions(track, slot)

    def to_boundaries(self, track: Tensor, position: Tensor) -> Tensor:
        """How far a car on one of these tracks [B] at this position [2, B] m is from the left and the right boundary.

        Returns:
            [2, B] in m, at most FAR.
        """
        node, columns, (right, up) = self.fine.locate(track, position)
        right, up = right.unsqueeze(-1), up.unsqueeze(-1)
        corners = (self.field.index_select(0, place) for place in (node, node + 1, node + columns, node + columns + 1))
        low_left, low_right, high_left, high_right = corners
        low, high = torch.lerp(low_left, low_right, right), torch.lerp(high_left, high_right, right)
        # Each side by itself: half-way between the two the nearer one changes, and no interpolation can follow that.
        return torch.lerp(low, high, up).t()

    def clearance(self, track: Tensor, cell: Tensor, position: Tensor, to_boundaries: Tensor | None = None) -> Tensor:
        """How far a car is from a crash: the nearer of cones and boundaries, less the distance that counts as one.

        Args:
            track: [B], the car's track.
            cell: [B], where it is.
            position: [2, B] in m.
            to_boundaries: [2, B] in m, where they are known already.

        Returns:
            [B] in m; zero or less is a crash. Exact up to 1 m, beyond that a cone may have been overlooked.
        """
        if to_boundaries is None:
            to_boundaries = self.to_boundaries(track, position)
        cones = self._positions(track, self.near.index_select(0, cell).t().contiguous())
        to_cone = (cones - position.unsqueeze(1)).square_().sum(0).amin(0).sqrt_()
        nearer = torch.minimum(*to_boundaries.unbind(0))
        return torch.minimum(to_cone - self.cone_radius, nearer - self.boundary_margin)

    def _positions(self, track: Tensor, slot: Tensor) -> Tensor:
        index = (slot + track.int() * (2 * self.slots)).flatten()
        return self.cones.index_select(1, index).view(2, *slot.shape)


# A program builds the same tracks into several envs, and this is the slowest part of building.
@lru_cache(maxsize=64)
def _boundary_distances(
    track: Track, low: tuple[float, float], high: tuple[float, float], cell: float, dtype: torch.dtype
) -> NDArray[np.float64]:
    """Distance of each grid node of one track from its left and its right boundary, at most FAR: [nodes, 2] m."""
    nodes = Grid(np.array([low]), np.array([high]), cell, dtype).nodes(0)
    trees = [cKDTree(track.boundary(side, 0.02)) for side in ("left", "right")]
    distances = [tree.query(nodes, distance_upper_bound=FAR, workers=-1)[0] for tree in trees]
    return np.minimum(np.stack(distances, axis=1), FAR)


def _columns(mask: NDArray[np.bool_], padding: int) -> NDArray[np.int64]:
    """The places of each last row's True entries, ascending, padded to the longest: [..., N] to [..., most]."""
    counts = mask.sum(axis=-1)
    columns = np.full((*mask.shape[:-1], max(1, int(counts.max()))), padding)
    *row, column = np.nonzero(mask)
    first = np.cumsum(counts) - counts.ravel()
    columns[(*row, np.arange(len(column)) - np.repeat(first, counts.ravel()))] = column
    return columns


def _stack(tables: list[NDArray[np.int64]], padding: NDArray[np.int64]) -> NDArray[np.int64]:
    """Tables [rows, ..., most] of several tracks on one another, the narrower ones filled up with padding [..., 1]."""
    most = max(table.shape[-1] for table in tables)
    wide = [padding * np.ones((*table.shape[:-1], most), dtype=np.int64) for table in tables]
    for filled, table in zip(wide, tables, strict=True):
        filled[..., : table.shape[-1]] = table
    return np.concatenate(wide)
