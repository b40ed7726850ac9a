"""Tracks as lookup tables: what a car at a pose could see, and how far it is from a crash.

A step of thousands of cars cannot look at every cone of their tracks. Everything that does not move is therefore
worked out once: for each square metre and each twelfth of a turn the cones that a car there may see, and on a fine grid
the distance to the nearest boundary. A step then reads a few numbers per car.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from coil_rl.envs.constants import constant
from coil_rl.envs.splines import slots_in_use
from coil_rl.envs.track import Track
from coil_rl.envs.track_tables import SECTORS, Grid, Nearby, boundary_distances, nearby

EXACT = 1.0  # m: a clearance up to this counts every cone, a larger one perhaps only the boundaries


class Place(NamedTuple):
    """Where cars are on their tracks, in the tables of a `TrackMap`.

    Attributes:
        track: [B], the cars' tracks.
        position: [2, B] m.
        finish: [2, B] m, the middle of the finish line of the car's track.
        cell: [B], the cell of candidate cones that the car is in.
        nodes: [2, B], the nodes of the distance field to its lower and to its upper left.
        share: [2, B], how far the car is from there towards the nodes to the right and above, 0 to 1.
    """

    track: Tensor
    position: Tensor
    finish: Tensor
    cell: Tensor
    nodes: Tensor
    share: Tensor


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
    starts: Tensor
    points: Tensor
    counts: Tensor
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
        self._keep("starts", np.array([track.start for track in tracks]).T, dtype)

        areas = [(tuple(low.tolist()), tuple(high.tolist())) for low, high in zip(lows, highs, strict=True)]
        self._keep_nearby(
            [
                nearby(track, *area, cell, dtype, sight, half_field_of_view, cone_radius + EXACT)
                for track, area in zip(tracks, areas, strict=True)
            ],
            [len(left) for left, _ in rings],
        )
        field = [boundary_distances(track, *area, field_cell, dtype) for track, area in zip(tracks, areas, strict=True)]
        self._keep("field", np.concatenate(field).ravel(), dtype)

        # What a step needs to know of a car's track, one column a track: points in m, and whole numbers.
        grids = [Grid(lows, highs, edge, dtype) for edge in (cell, field_cell)]
        self.edges = (cell, field_cell)
        finish = np.stack([track.finish for track in tracks], axis=1)
        self._keep("points", np.vstack([finish, grids[0].low, *[grid.last for grid in grids]]), dtype)
        counts = [*[grid.columns for grid in grids], *[grid.offset for grid in grids]]
        self._keep("counts", np.stack(counts), torch.int64)

    def __len__(self) -> int:
        return len(self.names)

    def _keep(self, name: str, values: NDArray[np.generic], dtype: torch.dtype) -> None:
        self.register_buffer(name, torch.as_tensor(np.ascontiguousarray(values), dtype=dtype), persistent=False)

    def _keep_nearby(self, found: list[Nearby], lefts: list[int]) -> None:
        """Fill `candidate` [blocks * SECTORS, most * 2], `listed`, `block` (its block for each cell) and `near`.

        `listed` says how many candidates the side that has more of them really has.
        """
        missing = self.slots - 1
        padding = np.array([[missing], [self.slots + missing]])
        seen, blocks, nears = [padding * np.ones((SECTORS, 1, 1), dtype=np.int64)], [], []
        filled = 1
        for (used, visible, near), left in zip(found, lefts, strict=True):
            blocks.append(np.where(used, filled + np.cumsum(used) - 1, 0))
            filled += int(used.sum())
            places = np.where(visible < 0, missing, visible) + np.array([[0], [self.slots]])
            seen.append(places.reshape(-1, 2, places.shape[-1]))
            nears.append(np.where(near < 0, missing, np.where(near < left, near, near - left + self.slots)))
        candidate = _stack(seen, padding)
        self.most = candidate.shape[-1]
        self._keep("candidate", candidate.swapaxes(-1, -2).reshape(-1, 2 * self.most), torch.int16)
        self._keep("listed", (candidate != padding).sum(-1).max(-1).reshape(-1), torch.int16)
        self._keep("block", np.concatenate(blocks), torch.int64)
        self._keep("near", _stack(nears, np.array([missing])), torch.int32)

    def locate(self, track: Tensor, position: Tensor) -> Place:
        """Look up where cars on these tracks [B] at these positions [2, B] m are.

        A position off the map counts as the nearest one on it.
        """
        points = self.points.index_select(1, track).view(4, 2, -1)
        finish, low, last = points[0], points[1], points[2:]
        columns, offset = self.counts.index_select(1, track).view(2, 2, -1).unbind(0)
        at = (position - low).unsqueeze(0)
        at = at / constant(self.edges, at)
        corner = torch.minimum(at.floor().clamp_(min=0), last)
        column, row = corner.long().unbind(1)
        cell, node = torch.addcmul(offset + column, row, columns).unbind(0)
        share = (at[1] - corner[1]).clamp_(0, 1)
        nodes = torch.stack([node, node + columns[1]])
        return Place(track.int(), position, finish, cell, nodes, share)

    def candidates(self, place: Place, heading: Tensor) -> tuple[Tensor, Tensor]:
        """The cones a car may see, never fewer than it does.

        Args:
            place: where cars are.
            heading: [B], radians.

        Returns:
            Slot of each candidate among its track's cones [N, 2, B] (left then right, rings padded to `slots`),
            ascending, and its position [2, N, 2, B] in m; padding lies 10 km away.
        """
        sector = (heading * constant(SECTORS / (2 * np.pi), heading)).floor_().remainder_(constant(SECTORS, heading))
        row = torch.add(sector.long(), self.block.index_select(0, place.cell), alpha=SECTORS)
        most = slots_in_use(self.listed.index_select(0, row), self.most)
        slot = _cars_last(self.candidate.index_select(0, row)[:, : 2 * most]).view(most, 2, -1)
        return slot, self._positions(place.track, slot)

    def to_boundaries(self, place: Place) -> Tensor:
        """How far cars are from the left and the right boundary.

        Returns:
            [2, B] in m, at most 3.
        """
        nodes = place.nodes.unsqueeze(0)
        # A node's two distances, and those of the node to its right, follow one another.
        index = torch.add(constant(range(4), nodes), nodes, alpha=2).flatten()
        left, right = self.field.index_select(0, index).view(2, 2, 2, -1).unbind(0)
        low, high = torch.lerp(left, right, place.share[0]).unbind(1)
        # Each side by itself: half-way between the two the nearer one changes, and no interpolation can follow that.
        return torch.lerp(low, high, place.share[1])

    def clearance(self, place: Place, to_boundaries: Tensor) -> Tensor:
        """How far cars are from a crash: the nearer of cones and boundaries, less the distance that counts as one.

        Args:
            place: where cars are.
            to_boundaries: [2, B] in m.

        Returns:
            [B] in m; zero or less is a crash. Exact up to 1 m, beyond that a cone may have been overlooked.
        """
        cones = self._positions(place.track, _cars_last(self.near.index_select(0, place.cell)))
        to_cone = (cones - place.position.unsqueeze(1)).square_().sum(0).amin(0).sqrt_()
        nearer = to_boundaries.amin(0)
        return torch.minimum(
            to_cone - constant(self.cone_radius, to_cone), nearer - constant(self.boundary_margin, nearer)
        )

    def _positions(self, track: Tensor, slot: Tensor) -> Tensor:
        index = torch.add(slot, track, alpha=2 * self.slots).flatten()
        return self.cones.index_select(1, index).view(2, *slot.shape)


def _cars_last(rows: Tensor) -> Tensor:
    """Rows of small integers [B, N] as columns of int32 [N, B]."""
    return rows.t().to(torch.int32, memory_format=torch.contiguous_format)


def _stack(tables: list[NDArray[np.int64]], padding: NDArray[np.int64]) -> NDArray[np.int64]:
    """Tables [rows, ..., most] of several tracks on one another, the narrower ones filled up with padding [..., 1]."""
    most = max(table.shape[-1] for table in tables)
    wide = [padding * np.ones((*table.shape[:-1], most), dtype=np.int64) for table in tables]
    for filled, table in zip(wide, tables, strict=True):
        filled[..., : table.shape[-1]] = table
    return np.concatenate(wide)
