"""Tracks as lookup tables: what a car at a pose could see, and how far it is from a crash.

A step of thousands of cars cannot look at every cone of their tracks. Everything that does not move is therefore
worked out once: for each square metre and each twelfth of a turn the cones that a car there may see, and on a fine grid
the distance to the nearest boundary. A step then reads a few numbers per car.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from coil_rl.envs.splines import slots_in_use
from coil_rl.envs.track import Track
from coil_rl.envs.track_tables import SECTORS, Grid, Nearby, boundary_distances, nearby

EXACT = 1.0  # m: a clearance up to this counts every cone, a larger one perhaps only the boundaries


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

        areas = [(tuple(low.tolist()), tuple(high.tolist())) for low, high in zip(lows, highs, strict=True)]
        self.cells = Grid(lows, highs, cell, dtype)
        self._keep_nearby(
            [
                nearby(track, *area, cell, dtype, sight, half_field_of_view, cone_radius + EXACT)
                for track, area in zip(tracks, areas, strict=True)
            ],
            [len(left) for left, _ in rings],
        )
        self.fine = Grid(lows, highs, field_cell, dtype)
        field = [boundary_distances(track, *area, field_cell, dtype) for track, area in zip(tracks, areas, strict=True)]
        self._keep("field", np.concatenate(field), dtype)

    def __len__(self) -> int:
        return len(self.names)

    def _keep(self, name: str, values: NDArray[np.generic], dtype: torch.dtype) -> None:
        self.register_buffer(name, torch.as_tensor(np.ascontiguousarray(values), dtype=dtype), persistent=False)

    def _keep_nearby(self, found: list[Nearby], lefts: list[int]) -> None:
        """Fill `candidate` [blocks * SECTORS, 2 * most], `listed`, `block` (its block for each cell) and `near`.

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
        self._keep("candidate", candidate.reshape(-1, 2 * self.most), torch.int16)
        self._keep("listed", (candidate != padding).sum(-1).max(-1).reshape(-1), torch.int16)
        self._keep("block", np.concatenate(blocks), torch.int64)
        self._keep("near", _stack(nears, np.array([missing])), torch.int32)

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
            [2, B] in m, at most 3.
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


def _stack(tables: list[NDArray[np.int64]], padding: NDArray[np.int64]) -> NDArray[np.int64]:
    """Tables [rows, ..., most] of several tracks on one another, the narrower ones filled up with padding [..., 1]."""
    most = max(table.shape[-1] for table in tables)
    wide = [padding * np.ones((*table.shape[:-1], most), dtype=np.int64) for table in tables]
    for filled, table in zip(wide, tables, strict=True):
        filled[..., : table.shape[-1]] = table
    return np.concatenate(wide)
