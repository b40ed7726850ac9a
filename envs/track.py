"""Cone tracks: two closed rings of cones and the boundary curves through them.

A `Track` that exists is one that can be driven: the constructor checks all that the worlds rely on.
The same class serves the cone world and, in its own metres, the simulated robot.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Side = Literal["left", "right"]

SIDES: tuple[Side, Side] = ("left", "right")
AS_COMPLEX = np.array([1, 1j])
# Limits of a track. Boundaries are sampled every few centimetres and an env stores a grid of the
# whole area, so a level in millimetres would fill the memory.
MIN_CONES, MAX_CONES = 4, 1000
MAX_COORDINATE = 10_000.0  # m
MAX_EXTENT, MAX_LENGTH = 500.0, 5000.0  # m, of a side
NEVER = -(2**30)  # step at which a lap began, before the first entry of the finish circle
PLACE_SPACING = 0.1  # m, of the line on which places are chosen
GOLDEN_RATIO = (5**0.5 - 1) / 2  # of a lap, from place to place: spreads any number of them evenly
MAX_PAIRS = 2 * 10**7  # of boundary segments tested for crossings


class TrackError(ValueError):
    """An invalid track or level file; one sentence names the fault and the remedy."""


@dataclass(frozen=True, eq=False)
class Track:
    """A closed track between two rings of cones; tracks are equal if all of their numbers are.

    Cars crash into the boundary curves, so all checks use these; they may overshoot the polygon
    through the cones.

    Args:
        name: for display.
        left: the cones of the left side in driving order, [N, 2] m, x right and y up.
        right: the cones of the right side in driving order, [M, 2] m.
        start: x in m, y in m, heading in radians anticlockwise from +x; by default the midpoint of
            the last left and the last right cone, heading for the finish.

    Raises:
        TrackError: for too few, too many, coincident or non-finite cones, sides beyond the limits,
            boundaries that cross themselves or each other, a left side that is not on the left, or
            a start or finish off the track.

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
    start: tuple[float, float, float] = None  # type: ignore[assignment]  # set in __post_init__

    def __post_init__(self) -> None:
        for side in SIDES:
            cones = np.array(getattr(self, side), dtype=np.float64)
            _check_cones(f"{side} side of track {self.name!r}", cones)
            cones.flags.writeable = False
            object.__setattr__(self, side, cones)
        rings = {side: self.boundary(side, 0.1) for side in SIDES}
        self._check_boundaries(rings)
        if self.start is None:
            start = (self.left[-1] + self.right[-1]) / 2
            forward = self.finish - start
            pose = (float(start[0]), float(start[1]), float(np.arctan2(forward[1], forward[0])))
        else:
            pose = tuple(float(value) for value in self.start)
        if len(pose) != 3 or not (np.abs(pose) <= MAX_COORDINATE).all():
            raise TrackError(
                f"The start of track {self.name!r} is {self.start}; give three finite numbers x, "
                f"y, heading, of at most {MAX_COORDINATE:.0f}."
            )
        object.__setattr__(self, "start", pose)
        for name, point in (("start", np.array(pose[:2])), ("finish", self.finish)):
            if _encloses(rings["left"], point) == _encloses(rings["right"], point):
                raise TrackError(
                    f"The {name} of track {self.name!r} at {np.round(point, 2).tolist()} is not "
                    "between its two sides; give a start on the track, y pointing up, and list "
                    "both sides from the same place on."
                )

    @cached_property
    def _content(self) -> tuple[str, bytes, bytes, tuple[float, ...]]:
        return self.name, self.left.tobytes(), self.right.tobytes(), self.start

    # Equal tracks, such as those of a file that is read again, share the tables of their maps.
    def __eq__(self, other: object) -> bool:
        """Return whether another track has the same name, cones and start."""
        return isinstance(other, Track) and self._content == other._content

    def __hash__(self) -> int:
        """Return a hash of name, cones and start."""
        return hash(self._content)

    @property
    def finish(self) -> Array:
        """Return the midpoint of the first left and the first right cone: [2], m."""
        return (self.left[0] + self.right[0]) / 2

    @property
    def length(self) -> float:
        """Return the length of a lap in m: the mean length of the two boundaries."""
        edges = [_edges(self.boundary(side)) for side in SIDES]
        return float(np.mean([np.linalg.norm(edge, axis=1).sum() for edge in edges]))

    def boundary(self, side: Side, spacing: float = 0.05) -> Array:
        """Sample a boundary: [P, 2] m, from the first cone on, which is not repeated at the end.

        A boundary is the closed cubic spline through the cones of a side by chord length.

        Args:
            side: "left" or "right".
            spacing: m, largest distance of two points along the chords.
        """
        from scipy.interpolate import CubicSpline  # takes half a second

        cones: Array = getattr(self, side)
        chord = _travelled(cones)
        curve = CubicSpline(chord, np.vstack([cones, cones[:1]]), bc_type="periodic")
        return curve(np.linspace(0, chord[-1], int(np.ceil(chord[-1] / spacing)), endpoint=False))

    def middle(self, spacing: float = 0.05) -> Array:
        """Return the middle of the track: [P, 2] m.

        Each point is the midpoint of a left boundary point and its nearest right one.

        Args:
            spacing: m, largest distance of two boundary points along the chords.
        """
        from scipy.spatial import cKDTree  # takes a quarter of a second

        left, right = self.boundary("left", spacing), self.boundary("right", spacing)
        return np.asarray((left + right[cKDTree(right).query(left)[1]]) / 2)

    def _check_boundaries(self, rings: dict[Side, Array]) -> None:
        """Raise a `TrackError` for boundaries [P, 2] m that are no valid track."""
        for side, ring in rings.items():
            if not np.isfinite(ring).all() or np.ptp(ring, axis=0).max() > 2 * MAX_EXTENT:
                raise TrackError(
                    f"The {side} boundary of track {self.name!r} swings far out between its cones; "
                    "space them evenly, in driving order."
                )
        crossing = _first_crossing(rings)
        if crossing is not None:
            sides, point = crossing
            if len(sides) == 2:
                subject = "two sides cross each other"
            else:
                subject = f"{sides.pop()} side crosses itself"
            raise TrackError(
                f"The {subject} near {np.round(point, 2).tolist()} on track {self.name!r}; list "
                "each side's cones in driving order and keep the two sides apart."
            )
        # By the sign of the enclosed areas.
        lines = [rings[side] @ AS_COMPLEX for side in SIDES]
        anticlockwise = [(line.conj() * np.roll(line, -1)).imag.sum() > 0 for line in lines]
        # The left ring is the inner one of a track driven anticlockwise.
        inner, outer = SIDES if anticlockwise[0] else SIDES[::-1]
        if anticlockwise[0] != anticlockwise[1] or not _encloses(rings[outer], rings[inner][0]):
            raise TrackError(
                f"The left side of track {self.name!r} is not on the left of its driving "
                "direction; list both sides in driving order, or swap LEFT and RIGHT."
            )


@lru_cache(maxsize=1024)
def begin_in_sight(track: Track, sight: float, half_angle: float) -> Track:
    """Return a track whose sides and finish line begin with the first cones seen from its start.

    Args:
        track: a side of which no cone is visible stays as it is.
        sight: m, range of view.
        half_angle: radians to either side of the heading.
    """
    x, y, heading = track.start
    rings = []
    for ring in (track.left, track.right):
        offset = (ring - (x, y)) @ AS_COMPLEX * np.exp(-1j * heading)
        visible = (np.abs(offset) < sight) & (np.abs(np.angle(offset)) < half_angle)
        rings.append(np.roll(ring, -int(visible.argmax()), axis=0))
    return Track(track.name, rings[0], rings[1], track.start)


def places(tracks: Sequence[Track], count: int | None) -> tuple[NDArray[np.int64], Array, Array]:
    """Choose places where an episode may begin.

    Place i is on track i mod len(tracks), in the middle of its width. The places of a track are
    spread along the lap, also if only the first ones are used.

    Args:
        count: P, number of places; None for the tracks' starts.

    Returns:
        Index of the track, [P]; pose, [P, 3]: x in m, y in m, heading in radians; and the distance
        along the lap from the finish, [P] m. It is NaN for the tracks' starts, where no lap has
        begun.
    """
    if count is None:
        starts = np.array([track.start for track in tracks])
        return np.arange(len(tracks)), starts, np.full(len(tracks), np.nan)
    of_each_track = -(-count // len(tracks))  # rounded up
    poses, driven = zip(*(_spread(track, of_each_track) for track in tracks), strict=True)
    index = np.arange(count) % len(tracks)
    return index, np.stack(poses, 1).reshape(-1, 3)[:count], np.stack(driven, 1).ravel()[:count]


def _spread(track: Track, count: int) -> tuple[Array, Array]:
    """Return poses [count, 3] along a track, and the distance of each from its finish in m."""
    middle = track.middle()
    middle = np.roll(middle, -int(((middle - track.finish) ** 2).sum(1).argmin()), axis=0)
    middle = resample(middle, PLACE_SPACING)
    at = ((np.arange(count) + 0.5) * GOLDEN_RATIO % 1 * len(middle)).astype(int)
    forward = (np.roll(middle, -1, axis=0) - np.roll(middle, 1, axis=0))[at]
    poses = np.column_stack([middle[at], np.arctan2(forward[:, 1], forward[:, 0])])
    return poses, _travelled(middle)[at]


def resample(ring: Array, spacing: float) -> Array:
    """Resample a closed line at equal steps, at least 8; the first point is kept.

    Args:
        ring: the line, [P, 2] m.
        spacing: m, approximate length of a step.
    """
    closed, travelled = np.vstack([ring, ring[:1]]), _travelled(ring)
    at = np.linspace(0, travelled[-1], max(8, round(travelled[-1] / spacing)), endpoint=False)
    return np.stack([np.interp(at, travelled, axis) for axis in closed.T], axis=1)


def _check_cones(side: str, cones: Array) -> None:
    """Raise a `TrackError` for the cones of a side that make no ring; `side` is for the message."""
    if cones.ndim != 2 or cones.shape[1] != 2 or not MIN_CONES <= len(cones) <= MAX_CONES:
        raise TrackError(
            f"The {side} has {len(cones)} cones, of shape {list(cones.shape)}; give {MIN_CONES} to "
            f"{MAX_CONES}, of shape [N, 2]."
        )
    outside = np.flatnonzero(~(np.abs(cones) <= MAX_COORDINATE).all(axis=1))
    if len(outside):
        raise TrackError(
            f"Cone {outside[0]} of the {side} lies at {cones[outside[0]].tolist()}; give finite "
            f"coordinates in m, at most {MAX_COORDINATE:.0f} from the origin."
        )
    lengths = np.linalg.norm(_edges(cones), axis=1)
    if np.ptp(cones, axis=0).max() > MAX_EXTENT or lengths.sum() > MAX_LENGTH:
        raise TrackError(
            f"The {side} is too large; the limits are {MAX_EXTENT:.0f} m across and "
            f"{MAX_LENGTH:.0f} m long."
        )
    coincident = np.flatnonzero(lengths < 1e-6)
    if len(coincident):
        first, second = coincident[0], (coincident[0] + 1) % len(cones)
        raise TrackError(
            f"Cones {first} and {second} of the {side} lie on the same spot; remove one of them "
            "(the ring closes by itself, its first cone is not repeated)."
        )


def _edges(ring: Array) -> Array:
    """Return the vectors from each point of a ring [P, 2] to the next one."""
    return np.roll(ring, -1, axis=0) - ring


def _travelled(ring: Array) -> Array:
    """Return the distance along a ring [P, 2] m to each point and back to the first: [P + 1] m."""
    return np.concatenate([[0.0], np.linalg.norm(_edges(ring), axis=1).cumsum()])


def _encloses(ring: Array, point: Array) -> bool:
    """Return whether a ring [P, 2] has a winding number other than 0 around a point [2]."""
    offset = (ring - point) @ AS_COMPLEX
    return bool(abs(np.angle(np.roll(offset, -1) * offset.conj()).sum()) > np.pi)


def _first_crossing(rings: dict[Side, Array]) -> tuple[set[Side], Array] | None:
    """Return the sides and the place of the first crossing of closed polylines [P, 2], or None."""
    from scipy.spatial import cKDTree

    begin = np.concatenate([rings[side] for side in SIDES])
    edge = np.concatenate([_edges(rings[side]) for side in SIDES])
    count = len(rings["left"])
    successor = np.arange(1, len(begin) + 1)
    successor[[count - 1, -1]] = 0, count
    # Two segments can only cross if their midpoints are no farther apart than the longest segment
    # is long.
    reach = np.linalg.norm(edge, axis=1).max()
    tree = cKDTree(begin + edge / 2)
    if tree.count_neighbors(tree, reach) > MAX_PAIRS:
        raise TrackError(
            "The boundaries overlap nearly everywhere; list each side's cones in driving order."
        )
    one, other = tree.query_pairs(reach, output_type="ndarray").T

    def on_left(point: NDArray[np.intp], line: NDArray[np.intp]) -> NDArray[np.bool_]:
        offset = begin[point] - begin[line]
        return np.asarray(edge[line, 0] * offset[:, 1] - edge[line, 1] * offset[:, 0] >= 0)

    crosses = (successor[one] != other) & (successor[other] != one)
    for line, segment in ((one, other), (other, one)):
        crosses &= on_left(segment, line) != on_left(successor[segment], line)
    if not crosses.any():
        return None
    first = int(crosses.argmax())
    return {SIDES[int(segment[first] >= count)] for segment in (one, other)}, begin[one[first]]
