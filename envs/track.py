"""Cone tracks: two closed rings of cones and the boundaries through them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Side = Literal["left", "right"]

SIDES: tuple[Side, Side] = ("left", "right")
MINIMUM_CONES = 4
AS_COMPLEX = np.array([1, 1j])
LARGEST_COORDINATE = 10_000.0
# Boundaries are sampled every few centimetres, and an env keeps a grid of the whole area: a level drawn in
# millimetres, or a file of something else, would fill the memory.
MOST_CONES = 1000
LARGEST_EXTENT = 500.0
LONGEST_SIDE = 5000.0
MOST_PAIRS = 2 * 10**7


class TrackError(ValueError):
    """A track, or a file that should hold one, cannot be driven; the message says which, why and what to do."""


@dataclass(frozen=True, eq=False)
class Track:
    """A closed track between two rings of cones.

    Whether the sides cross is asked of the boundary curves and not of the polygons through the cones, because the car
    crashes into the curves, which may overshoot a polygon that is fine.

    Args:
        name: what tables and figures call it.
        left: [N, 2], m, the cones of the left side in driving order, x right and y up.
        right: [M, 2], m, the cones of the right side.
        start: x in m, y in m, heading in rad anticlockwise from +x. Without one the car starts at the midpoint of the
            last left and the last right cone, heading for the finish.

    Raises:
        TrackError: if a side has fewer than four cones, more or farther apart than any track, cones that are not finite
            or lie on top of each other, if a boundary crosses itself or the other one, if left is not left of the
            driving direction, or if the start or the finish lies off the track.

    Example:
        >>> import numpy as np
        >>> turn = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        >>> circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
        >>> ring = Track("ring", left=9 * circle, right=11 * circle)
        >>> round(ring.length)
        63
    """

    name: str
    left: Array
    right: Array
    start: tuple[float, float, float] = None  # type: ignore[assignment]  # always a pose once constructed

    def __post_init__(self) -> None:
        for side in SIDES:
            cones = np.array(getattr(self, side), dtype=np.float64)
            self._check_cones(side, cones)
            cones.flags.writeable = False
            object.__setattr__(self, side, cones)
        rings = {side: self.boundary(side, 0.1) for side in SIDES}
        self._check_size(rings)
        self._check_boundaries(rings)
        pose = self._default_start() if self.start is None else tuple(float(value) for value in self.start)
        if len(pose) != 3 or not (np.abs(pose) <= LARGEST_COORDINATE).all():
            raise TrackError(
                f"The start of track {self.name!r} is {self.start}; give three finite numbers x, y, heading, "
                f"of at most {LARGEST_COORDINATE:.0f}."
            )
        object.__setattr__(self, "start", pose)
        for what, place in (("start", np.array(pose[:2])), ("finish", self.finish)):
            if _encloses(rings["left"], place) == _encloses(rings["right"], place):
                raise TrackError(
                    f"The {what} of track {self.name!r} at {np.round(place, 2).tolist()} is not between its two sides; "
                    "give a start on the track, y pointing up, and list both sides from the same place on."
                )

    @property
    def finish(self) -> Array:
        """[2], m: the midpoint of the first left and the first right cone."""
        middle: Array = (self.left[0] + self.right[0]) / 2
        return middle

    @property
    def length(self) -> float:
        """Length of a lap in m: the mean of the two boundaries, which is that of the line half-way between them."""
        return float(np.mean([np.linalg.norm(_edges(self.boundary(side)), axis=1).sum() for side in SIDES]))

    def boundary(self, side: Side, spacing: float = 0.05) -> Array:
        """Points along the boundary, which is the closed cubic spline through a side's cones by chord length.

        Args:
            side: "left" or "right".
            spacing: largest distance in m between two points along the chords.

        Returns:
            [P, 2], m, starting at the first cone, in driving order; the first point is not repeated at the end.
        """
        if side not in SIDES:
            raise ValueError(f"There is no side {side!r}; give 'left' or 'right'.")
        if not spacing > 0:
            raise ValueError(f"The spacing of boundary points is a distance in m above 0, not {spacing}.")
        cones = self.left if side == "left" else self.right
        chord = np.concatenate([[0.0], np.linalg.norm(_edges(cones), axis=1).cumsum()])
        curve = CubicSpline(chord, np.vstack([cones, cones[:1]]), bc_type="periodic")
        points: Array = curve(np.linspace(0, chord[-1], int(np.ceil(chord[-1] / spacing)), endpoint=False))
        return points

    def middle(self, spacing: float = 0.05) -> Array:
        """Half-way from each point of the left boundary to the nearest one of the right boundary: [P, 2], m.

        Args:
            spacing: of the boundaries, as there.
        """
        left, right = self.boundary("left", spacing), self.boundary("right", spacing)
        return np.asarray((left + right[cKDTree(right).query(left)[1]]) / 2)

    def _check_cones(self, side: str, cones: Array) -> None:
        if cones.ndim != 2 or cones.shape[1] != 2 or len(cones) < MINIMUM_CONES:
            raise TrackError(
                f"The {side} side of track {self.name!r} has {len(cones)} cones, of shape {list(cones.shape)}; "
                f"give at least {MINIMUM_CONES}, of shape [N, 2]."
            )
        if len(cones) > MOST_CONES:
            raise TrackError(
                f"The {side} side of track {self.name!r} has {len(cones)} cones; give at most {MOST_CONES}."
            )
        if not (np.abs(cones) <= LARGEST_COORDINATE).all():
            row = int(np.flatnonzero(~(np.abs(cones) <= LARGEST_COORDINATE).all(axis=1))[0])
            raise TrackError(
                f"Cone {row} of the {side} side of track {self.name!r} lies at {cones[row].tolist()}; give finite "
                f"coordinates in m, at most {LARGEST_COORDINATE:.0f} from the origin."
            )
        if np.ptp(cones, axis=0).max() > LARGEST_EXTENT or np.linalg.norm(_edges(cones), axis=1).sum() > LONGEST_SIDE:
            raise TrackError(
                f"The {side} side of track {self.name!r} is too large; it may be {LARGEST_EXTENT:.0f} across and "
                f"{LONGEST_SIDE:.0f} long, both in m."
            )
        double = np.flatnonzero(np.linalg.norm(_edges(cones), axis=1) < 1e-6)
        if len(double):
            here, after = double[0], (double[0] + 1) % len(cones)
            raise TrackError(
                f"Cones {here} and {after} of the {side} side of track {self.name!r} lie on the same spot; remove one "
                "of them (the ring closes by itself, its first cone is not repeated)."
            )

    def _check_size(self, rings: dict[Side, Array]) -> None:
        for side, ring in rings.items():
            if not np.isfinite(ring).all() or np.ptp(ring, axis=0).max() > 2 * LARGEST_EXTENT:
                raise TrackError(
                    f"The {side} boundary of track {self.name!r} swings far out between its cones; space them evenly, "
                    "in driving order."
                )

    def _check_boundaries(self, rings: dict[Side, Array]) -> None:
        crossing = _first_crossing(rings)
        if crossing is not None:
            sides, place = crossing
            what = "two sides cross each other" if len(sides) == 2 else f"{sides.pop()} side crosses itself"
            raise TrackError(
                f"The {what} near {np.round(place, 2).tolist()} on track {self.name!r}; "
                "list each side's cones in driving order and keep the two sides apart."
            )
        anticlockwise = [_area(rings[side]) > 0 for side in SIDES]
        # Driven anticlockwise the left ring is the inner one, driven clockwise the right ring is.
        inner, outer = SIDES if anticlockwise[0] else SIDES[::-1]
        if anticlockwise[0] != anticlockwise[1] or not _encloses(rings[outer], rings[inner][0]):
            raise TrackError(
                f"The left side of track {self.name!r} is not on the left of its driving direction; list both sides in "
                "driving order, or swap LEFT and RIGHT."
            )

    def _default_start(self) -> tuple[float, float, float]:
        place = (self.left[-1] + self.right[-1]) / 2
        ahead = self.finish - place
        return float(place[0]), float(place[1]), float(np.arctan2(ahead[1], ahead[0]))


def evenly(ring: Array, spacing: float) -> Array:
    """Points along a closed line [P, 2], the last of them a step of about `spacing` before the first."""
    closed = np.vstack([ring, ring[:1]])
    travelled = np.concatenate([[0.0], np.linalg.norm(np.diff(closed, axis=0), axis=1).cumsum()])
    at = np.linspace(0, travelled[-1], max(8, round(travelled[-1] / spacing)), endpoint=False)
    return np.stack([np.interp(at, travelled, axis) for axis in closed.T], axis=1)


def _edges(ring: Array) -> Array:
    edges: Array = np.roll(ring, -1, axis=0) - ring
    return edges


def _area(ring: Array) -> float:
    """Enclosed by a ring [P, 2], in m^2, above 0 if it runs anticlockwise."""
    points = ring @ AS_COMPLEX
    return float((points.conj() * np.roll(points, -1)).imag.sum() / 2)


def _encloses(ring: Array, place: Array) -> bool:
    """Whether a ring [P, 2] runs around a place [2]: its winding number is not 0."""
    seen = (ring - place) @ AS_COMPLEX
    return bool(abs(np.angle(np.roll(seen, -1) * seen.conj()).sum()) > np.pi)


def _first_crossing(rings: dict[Side, Array]) -> tuple[set[Side], Array] | None:
    """Which of the closed polylines [P, 2] cross, one itself or both each other, and where; None if none do."""
    begin = np.concatenate([rings[side] for side in SIDES])
    edge = np.concatenate([_edges(rings[side]) for side in SIDES])
    count = len(rings["left"])
    after = np.arange(1, len(begin) + 1)
    after[[count - 1, -1]] = 0, count
    # Two pieces can only meet if their middles are no farther apart than the longest piece is long.
    reach = np.linalg.norm(edge, axis=1).max()
    tree = cKDTree(begin + edge / 2)
    if tree.count_neighbors(tree, reach) > MOST_PAIRS:
        raise TrackError("The boundaries are a tangle; list each side's cones in driving order, evenly spaced.")
    one, other = tree.query_pairs(reach, output_type="ndarray").T

    def on_left(point: NDArray[np.intp], line: NDArray[np.intp]) -> NDArray[np.bool_]:
        to = begin[point] - begin[line]
        return np.asarray(edge[line, 0] * to[:, 1] - edge[line, 1] * to[:, 0] >= 0)

    crosses = (after[one] != other) & (after[other] != one)
    for line, piece in ((one, other), (other, one)):
        crosses &= on_left(piece, line) != on_left(after[piece], line)
    if not crosses.any():
        return None
    first = int(crosses.argmax())
    return {SIDES[int(piece[first] >= count)] for piece in (one, other)}, begin[one[first]]
