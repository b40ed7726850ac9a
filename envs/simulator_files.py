"""Tracks of Formula Student simulators: CSV with a cone a line, blue left and yellow right.

Two headers are known: `cone_type,X,Y,...` of the driverless simulators, where orange cones may have
a side in the columns `right` and `left`, and `tag,x,y,...` of EUFS, where a line `car_start` has
the pose of the car. The y axis points up. The cones of a side come in any order.
"""

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.track import Track, TrackError

Array = NDArray[np.float64]
Row = tuple[int, Mapping[str, str]]  # number of the line, and its cells by column in lower case

SIDES_OF_COLOURS = {"blue": "left", "yellow": "right"}
KINDS = ("cone_type", "tag")  # names of the column with the colour
START = "car_start"


def is_of_simulator(header: Sequence[str]) -> bool:
    """Return whether the columns of a CSV are those of a simulator."""
    columns = [name.casefold() for name in header]
    return bool(columns) and columns[0] in KINDS and {"x", "y"} <= set(columns)


def simulator_track(
    name: str, column: str, rows: Sequence[Row], start: tuple[float, float, float] | None
) -> Track:
    """Return the track of a simulator's file.

    Cones of other colours than blue and yellow are left out, unless a column names their side.

    Args:
        column: with the colours.
        start: m, m, radians; None for that of the file, or just before the first cones.

    Raises:
        TrackError: for a number that is none, and for cones that are no track.
    """
    sides: dict[str, list[tuple[float, float]]] = {"left": [], "right": []}
    for line, row in rows:
        kind = row.get(column, "").casefold()
        side = SIDES_OF_COLOURS.get(kind) or _flagged(row)
        if side is not None:
            sides[side].append(numbers(row, ("x", "y"), line))  # type: ignore[arg-type]
        elif kind == START and start is None:
            start = numbers(row, ("x", "y", "direction"), line)  # type: ignore[assignment]
    left, right = (np.reshape(cones, (-1, 2)) for cones in sides.values())
    if min(len(left), len(right)) < 1:
        raise TrackError(
            f"it has {len(left)} blue (left) and {len(right)} yellow (right) cones; give both"
        )
    problems = []
    for ordered in _orders(left, right, start):
        try:
            return Track(name, *ordered, start)  # type: ignore[arg-type]
        except TrackError as error:
            problems.append(error)
    raise problems[0]


def _flagged(row: Mapping[str, str]) -> str | None:
    """Return the side that the columns `left` and `right` name, None if they name none."""
    flags = [side for side in ("left", "right") if row.get(side, "").strip() in ("1", "1.0")]
    return flags[0] if len(flags) == 1 else None


def numbers(row: Mapping[str, str], keys: Sequence[str], line: int) -> tuple[float, ...]:
    """Return finite numbers of a row, by columns in any case; a missing direction is 0.

    Args:
        line: number of the row, for the message of a `TrackError`.
    """
    cells = [row.get(key.casefold()) or ("0" if key == "direction" else "") for key in keys]
    try:
        return tuple(np.asarray_chkfinite(cells, dtype=np.float64).tolist())
    except ValueError:
        raise TrackError(
            f"line {line}: {', '.join(keys)} are {cells}; they must be finite numbers in m"
        ) from None


def _orders(
    left: Array, right: Array, start: tuple[float, float, float] | None
) -> Iterator[tuple[Array, Array]]:
    """Yield the sides in driving order: as in the file, then by their nearest neighbours.

    The left side is on the left, and both begin at the start, or with the first left cone.

    Args:
        left: [N, 2] m.
        right: [M, 2] m.
        start: m, m, radians.
    """
    for sides in ((left, right), (_chain(left), _chain(right))):
        outer_is_left = abs(_area(sides[0])) > abs(_area(sides[1]))
        turned = []
        for side in sides:  # clockwise if the left side is the outer one
            clockwise = _area(side) < 0
            turned.append(side if clockwise == outer_is_left else side[::-1])
        first = turned[0][0] if start is None else _ahead(turned[0], start)
        yield tuple(_from(side, first) for side in turned)  # type: ignore[misc]


def _chain(cones: Array) -> Array:
    """Return cones in the order in which each is the nearest of those that are left."""
    waiting, order = list(range(1, len(cones))), [0]
    while waiting:
        distance = np.hypot(*(cones[waiting] - cones[order[-1]]).T)
        order.append(waiting.pop(int(distance.argmin())))
    return np.asarray(cones[order])


def _area(ring: Array) -> float:
    """Return the area inside a ring in m^2, positive anticlockwise."""
    x, y = ring.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _ahead(cones: Array, start: tuple[float, float, float]) -> Array:
    """Return the nearest of the cones ahead of a start, or of all if there is none ahead."""
    offset = cones - start[:2]
    forward = offset @ [math.cos(start[2]), math.sin(start[2])]
    distance = np.where(forward > 0, np.hypot(*offset.T), np.inf)
    nearest = distance if np.isfinite(distance).any() else np.hypot(*offset.T)
    return np.asarray(cones[int(nearest.argmin())])


def _from(cones: Array, first: Array) -> Array:
    """Return a ring that begins with its cone nearest to a point."""
    return np.roll(cones, -int(np.hypot(*(cones - first).T).argmin()), axis=0)
