"""Random tracks: circuits with straights, esses and hairpins, each determined by its seed.

The centre line is the outline of a few grid cells that grow at random without enclosing a hole, so
it is one loop. The grid has uneven rows and columns; some corners of the outline are dropped, the
others are moved, rounded by arcs and smoothed. Draws that are too tight or too close to themselves
are rejected. Points are complex numbers x + iy in this module, lengths are in m and curvatures in
1/m.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.track import Array, Track, TrackError

Line = NDArray[np.complex128]

# Requirements.
LAP = (59.0, 146.0)  # length of a lap
WIDTH = (1.9, 2.9)  # of the track
RADIUS, INNER_RADIUS = 2.5, 1.6  # smallest ones of the middle line and of the inner boundary
FREE_SPACE = 2.0  # between two parts of the track
# distance along the lap within which the radius alone keeps two points apart, half a hairpin
NEIGHBOURS = 8.0
CONE_GAP = 1.62  # mean distance of two cones of a side
# Parameters of the draw.
CELL = (5.8, 8.8)  # width of the rows and columns of the grid
# An outline of n cells has up to 2 n + 2 edges, some of which the corners remove.
CELLS_PER_METRE = 0.078
SMOOTHING = 1.0  # standard deviation of the filter
STEP, FINE_STEP = 0.25, 0.1  # between two points of the middle line, at the end and before
TRIES = 5000  # draws until one makes a track
MAX_TRACKS = 10_000  # takes minutes


def random_track(seed: int, name: str | None = None) -> Track:
    """Return the random track of a seed.

    Args:
        seed: an integer of at least 0, else a `ValueError`.
        name: of the track, "random_SEED" by default.
    """
    return _draw(seed, 0, name or f"random_{seed}")


def random_tracks(count: int, seed: int) -> list[Track]:
    """Return random tracks of a seed, the first one of which is like `random_track(seed)`.

    Args:
        count: number of tracks, from 1 to 10,000, else a `ValueError`.
        seed: an integer of at least 0; the first tracks of a seed are the same for any `count`.
    """
    if not 1 <= count <= MAX_TRACKS:
        raise ValueError(f"count={count} of random_tracks must be from 1 to {MAX_TRACKS}")
    return [_draw(seed, k, f"random_{seed}_{k}") for k in range(count)]


# Tracks are immutable, so they can be shared. Untyped, the cache would take True for 1.
@lru_cache(maxsize=256, typed=True)
def _draw(seed: int, k: int, name: str) -> Track:
    """Return track number `k` of a seed, drawn again until a draw makes a track."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed={seed!r} of a random track must be an integer of at least 0")
    rng = np.random.default_rng([seed, k])
    # Drawn once for all tries, because short laps are accepted more often.
    lap = rng.uniform(*LAP)
    for _ in range(TRIES):
        line = _centre_line(rng, lap)
        if rng.random() < 0.5:
            line = line[::-1]
        width = _width(rng, len(line))
        if not _drivable(line, width):
            continue
        first = _start(line)
        if first is None:
            continue
        line, width = np.roll(line, -first), np.roll(width, -first)
        heading = (line[1] - line[-1]) / abs(line[1] - line[-1])
        # The finish is at the origin and is crossed along +x on every track.
        line = (line - line[0]) / heading
        chord = np.roll(line, -1) - np.roll(line, 1)
        to_left = 0.5j * width * (chord / np.abs(chord))
        return Track(name, _cones(rng, line + to_left), _cones(rng, line - to_left))
    raise TrackError(f"None of {TRIES} draws of seed {seed} makes a track; take another seed.")


def _centre_line(rng: np.random.Generator, lap: float) -> Line:
    """Draw a closed anticlockwise line of length `lap` with equidistant points: [lap / STEP]."""
    from scipy.ndimage import gaussian_filter1d  # only drawn tracks need it

    corners = _corners(rng, _outline(rng, max(3, round(CELLS_PER_METRE * lap - 1))))
    edges = np.roll(corners, -1) - corners
    shorter = np.minimum(np.abs(edges), np.roll(np.abs(edges), -1))
    line = _rounded(edges, shorter / 2 * rng.uniform(0.75, 1, len(edges)))
    line = gaussian_filter1d(line, SMOOTHING / FINE_STEP, mode="wrap")
    line = _resampled(line, np.linspace(0, 1, round(lap / STEP), endpoint=False))
    return line * lap / np.abs(np.roll(line, -1) - line).sum()


def _rounded(edges: Line, cut: Array) -> Line:
    """Replace the corners of a closed polygon by arcs; return points at equal steps.

    Args:
        edges: of the polygon, [C].
        cut: distance of both ends of an arc from its corner, [C].
    """
    turns = np.angle(np.roll(edges, -1) / edges)
    straights = np.abs(edges) - cut - np.roll(cut, 1)
    # The radius is cut / tan(turn / 2); without a turn, any small angle gives the right length, 2
    # cut.
    angles = np.maximum(np.abs(turns), 1e-3)
    arcs = cut * angles / np.tan(angles / 2)
    travelled = np.cumsum(np.stack([straights, arcs], axis=1))
    headings = np.angle(edges[0]) + np.cumsum(np.stack([np.zeros(len(edges)), turns], axis=1))
    at = np.arange(0, travelled[-1], FINE_STEP)
    heading = np.interp(at, np.append(0, travelled), np.append(headings[0], headings))
    line: Line = np.exp(1j * heading).cumsum() * FINE_STEP
    # A lap is not a whole number of steps; distributing the gap closes the line.
    line -= (line[-1] - line[0]) * np.linspace(0, 1, len(line))
    return line[:-1]


def _outline(rng: np.random.Generator, size: int) -> list[tuple[int, int]]:
    """Draw `size` connected grid cells and return their outline, anticlockwise."""
    ring = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]
    cells = {(0, 0)}
    while len(cells) < size:
        origin = sorted(cells)[rng.integers(len(cells))]
        step = ring[2 * rng.integers(4)]
        cell = (origin[0] + step[0], origin[1] + step[1])
        taken = [(cell[0] + i, cell[1] + j) in cells for i, j in ring]
        # Contiguous neighbours leave no hole and no corner at which the outline touches itself.
        # Thin branches make the hairpins, so cells with several neighbours are accepted less often.
        groups = sum(taken[i] and not taken[i - 1] for i in range(len(taken)))
        if cell not in cells and groups == 1 and rng.random() < 0.15 ** (sum(taken[::2]) - 1):
            cells.add(cell)
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    edges: set[tuple[tuple[int, int], tuple[int, int]]] = set()
    for x, y in cells:
        corners = [(x + i, y + j) for i, j in square]
        edges.update(zip(corners, corners[1:] + corners[:1], strict=True))
    # An edge between two cells is there in both directions, and not part of the outline.
    successor = {a: b for a, b in edges if (b, a) not in edges}
    path = [min(successor)]
    while successor[path[-1]] != path[0]:
        path.append(successor[path[-1]])
    return path


def _corners(rng: np.random.Generator, path: list[tuple[int, int]]) -> Line:
    """Place the outline on an uneven grid, move its corners and drop some: [C]."""
    steps = np.array(path) - np.min(path, axis=0)
    grid = np.cumsum(rng.uniform(*CELL, (2, steps.max() + 1)), axis=1)
    corners = grid[0][steps[:, 0]] + 1j * grid[1][steps[:, 1]]
    corners += rng.uniform(-1.2, 1.2, len(corners)) + 1j * rng.uniform(-1.2, 1.2, len(corners))
    straight = (steps - np.roll(steps, 1, axis=0) == np.roll(steps, -1, axis=0) - steps).all(axis=1)
    return corners[rng.random(len(corners)) > np.where(straight, 0.5, 0.1)]


def _width(rng: np.random.Generator, points: int) -> Array:
    """Draw a track width that varies slowly along the lap: [points]."""
    turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
    waves = np.arange(1, 2 + points * STEP // 20)
    phases = rng.uniform(0, 2 * np.pi, len(waves))
    wave = np.cos(np.outer(turn, waves) + phases) @ rng.normal(size=len(waves))
    middle = rng.uniform(0.3, 0.7)
    return WIDTH[0] + (WIDTH[1] - WIDTH[0]) * (middle + 0.3 * wave / np.abs(wave).max())


def _drivable(line: Line, width: Array) -> bool:
    """Return whether a line makes a track.

    No turn may be too tight, and the track must turn both ways and keep its distance from itself.

    Args:
        line: the middle of the track, [points].
        width: of the track, [points].
    """
    bend = _curvature(line)
    tight = np.abs(bend).max() * RADIUS > 1 or (np.abs(bend) * (INNER_RADIUS + width / 2)).max() > 1
    if tight or min(bend.max(), -bend.min()) < 0.15:
        return False
    # Half of the points suffices for distances of several metres.
    line, width = line[::2], width[::2]
    gap = np.abs(line[:, None] - line) - (width[:, None] + width) / 2
    steps = np.abs(np.arange(len(line))[:, None] - np.arange(len(line)))
    far = np.minimum(steps, len(line) - steps) * 2 * STEP > NEIGHBOURS
    return bool(gap[far].min() > FREE_SPACE)


def _start(line: Line) -> int | None:
    """Return the middle of the straightest 8 m, or None if these are too curved."""
    from scipy.ndimage import maximum_filter1d

    bends = maximum_filter1d(np.abs(_curvature(line)), round(8 / STEP) + 1, mode="wrap")
    return int(bends.argmin()) if bends.min() < 0.06 else None


def _cones(rng: np.random.Generator, side: Line) -> Array:
    """Place cones along a side as if by hand, a little off the line and unevenly spaced: [N, 2]."""
    length = np.abs(np.roll(side, -1) - side).sum()
    gaps = rng.uniform(0.88, 1.12, round(length / CONE_GAP))
    cones = _resampled(side, np.cumsum(gaps / gaps.sum()) - gaps[0] / gaps.sum())
    cones += rng.uniform(-0.04, 0.04, len(cones)) + 1j * rng.uniform(-0.04, 0.04, len(cones))
    return np.stack([cones.real, cones.imag], axis=1)


def _resampled(line: Line, fractions: Array) -> Line:
    """Return the points of a closed line at fractions of its length."""
    closed = np.append(line, line[0])
    travelled = np.concatenate([[0.0], np.abs(np.diff(closed)).cumsum()])
    return np.interp(fractions * travelled[-1], travelled, closed)


def _curvature(line: Line) -> Array:
    """Return the curvature at each point of a closed line with steps of `STEP`."""
    edge = np.roll(line, -1) - line
    return np.angle(edge / np.roll(edge, 1)) / STEP
