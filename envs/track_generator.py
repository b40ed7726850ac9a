"""Random tracks: circuits with straights, esses and hairpins, as many as wanted, each fixed by its seed.

The centre line is the outline of a few grid cells that grow at random without enclosing a hole, so it is one loop. The
grid has uneven rows and columns; some corners of the outline are dropped, the others are moved, rounded by arcs and
smoothed. A draw that is too tight somewhere, or too near to itself, is thrown away. Points are complex numbers x + iy
here, lengths are in m and curvatures in 1/m.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from coil_rl.envs.level_files import save_track
from coil_rl.envs.track import Track, TrackError

Array = NDArray[np.float64]
Line = NDArray[np.complex128]

# Chosen by eye, for laps of different lengths and difficulty in both directions. After changing one, write the files
# anew: python -c "from coil_rl.envs import track_generator; track_generator.write_shipped_tracks('envs/tracks')"
SHIPPED = {
    "train": {"train_1": 29, "train_2": 20, "train_3": 26, "train_4": 0, "train_5": 47, "train_6": 13, "train_7": 10},
    "test": {"test_1": 22, "test_2": 16, "test_3": 27},
}

# What a track must have: all in m.
LAP = (59.0, 146.0)
WIDTH = (1.9, 2.9)
RADIUS = 2.5
INNER_RADIUS = 1.6
FREE_SPACE = 2.0
# Within half a hairpin of each other two places are neighbours, and the radius alone keeps them apart.
NEIGHBOURS = 8.0
CONE_GAP = 1.62
# How one is drawn.
CELL = (5.8, 8.8)
# An outline of n cells has up to 2 n + 2 edges of a mean cell's length, and loses some at its corners.
CELLS_PER_METRE = 0.078
SMOOTHING = 1.0
STEP = 0.25
FINE_STEP = 0.1
TRIES = 5000
# To draw so many takes minutes.
MOST = 10_000


def random_track(seed: int, name: str | None = None) -> Track:
    """The track of a seed, the same on every call.

    Args:
        seed: a whole number from 0 on.
        name: what to call it; "random_SEED" if not given.

    Raises:
        ValueError: if the seed is no such number.
        TrackError: if no draw makes a track within the limit of tries; another seed will.
    """
    return _draw(seed, 0, name or f"random_{seed}")


def random_tracks(count: int, seed: int) -> list[Track]:
    """The first `count` tracks of a seed: track k is the same whatever the count, track 0 is `random_track(seed)`."""
    if not 1 <= count <= MOST:
        raise ValueError(f"random_tracks was asked for {count} tracks; ask for 1 to {MOST}.")
    return [_draw(seed, k, f"random_{seed}_{k}") for k in range(count)]


def write_shipped_tracks(folder: str | Path) -> None:
    """Draw the ten shipped tracks into FOLDER/train and FOLDER/test."""
    for split, seeds in SHIPPED.items():
        for name, seed in seeds.items():
            save_track(random_track(seed, name), Path(folder) / split / f"{name}.csv")


def _draw(seed: int, k: int, name: str) -> Track:
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"The seed of a random track is a whole number from 0 on, not {seed!r}.")
    return _search(int(seed), k, name)


# Tracks cannot be changed, so everybody may have the same ones.
@lru_cache(maxsize=256)
def _search(seed: int, k: int, name: str) -> Track:
    rng = np.random.default_rng([seed, k])
    # Drawn once for all tries: short laps pass more easily and would otherwise crowd out the long ones.
    lap = rng.uniform(*LAP)
    for _ in range(TRIES):
        line = _centre_line(rng, lap)
        if rng.random() < 0.5:
            line = line[::-1]
        width = _width(rng, len(line))
        if not _drivable(line, width) or (first := _start(line)) is None:
            continue
        line, width = np.roll(line, -first), np.roll(width, -first)
        heading = (line[1] - line[-1]) / abs(line[1] - line[-1])
        # The finish lies at the origin and is crossed along +x, so that every level opens alike.
        line = (line - line[0]) / heading
        to_left = 0.5j * width * _directions(line)
        return Track(name, _cones(rng, line + to_left), _cones(rng, line - to_left))
    raise TrackError(f"None of {TRIES} draws of seed {seed} makes a track; take another seed.")


def _centre_line(rng: np.random.Generator, lap: float) -> Line:
    """[lap / STEP]: a closed line of length `lap`, anticlockwise, its points at equal distances."""
    corners = _corners(rng, _outline(rng, max(3, round(CELLS_PER_METRE * lap - 1))))
    edges = np.roll(corners, -1) - corners
    shorter = np.minimum(np.abs(edges), np.roll(np.abs(edges), -1))
    line = _rounded(edges, shorter / 2 * rng.uniform(0.75, 1, len(edges)))
    line = gaussian_filter1d(line, SMOOTHING / FINE_STEP, mode="wrap")
    line = _resampled(line, np.linspace(0, 1, round(lap / STEP), endpoint=False))
    return line * lap / np.abs(np.roll(line, -1) - line).sum()


def _rounded(edges: Line, cut: Array) -> Line:
    """The closed polygon of `edges` [C], with arcs from `cut` [C] before to `cut` after the corner at an edge's end."""
    turns = np.angle(np.roll(edges, -1) / edges)
    straights = np.abs(edges) - cut - np.roll(cut, 1)
    # The radius is cut / tan(turn / 2); where the line goes straight on, any small turn gives the right length, 2 cut.
    angles = np.maximum(np.abs(turns), 1e-3)
    arcs = cut * angles / np.tan(angles / 2)
    travelled = np.cumsum(np.stack([straights, arcs], axis=1))
    headings = np.angle(edges[0]) + np.cumsum(np.stack([np.zeros(len(edges)), turns], axis=1))
    at = np.arange(0, travelled[-1], FINE_STEP)
    heading = np.interp(at, np.append(0, travelled), np.append(headings[0], headings))
    line: Line = np.exp(1j * heading).cumsum() * FINE_STEP
    # The steps are not quite a whole number to the lap; spreading what is left over closes it.
    line -= (line[-1] - line[0]) * np.linspace(0, 1, len(line))
    return line[:-1]


def _outline(rng: np.random.Generator, size: int) -> list[tuple[int, int]]:
    """The outline of `size` grid cells, anticlockwise."""
    ring = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]
    cells = {(0, 0)}
    while len(cells) < size:
        beside = sorted(cells)[rng.integers(len(cells))]
        step = ring[2 * rng.integers(4)]
        cell = (beside[0] + step[0], beside[1] + step[1])
        taken = [(cell[0] + i, cell[1] + j) in cells for i, j in ring]
        # Taken neighbours that hang together leave no hole and no corner where the outline would touch itself; thin
        # branches make the hairpins, so that a place with several neighbours is filled less often.
        joined = sum(now and not before for now, before in zip(taken, taken[-1:] + taken[:-1], strict=True)) == 1
        if cell not in cells and joined and rng.random() < 0.15 ** (sum(taken[::2]) - 1):
            cells.add(cell)
    square = [(0, 0), (1, 0), (1, 1), (0, 1)]
    edges = {
        ((x + a[0], y + a[1]), (x + b[0], y + b[1]))
        for x, y in cells
        for a, b in zip(square, square[1:] + square[:1], strict=True)
    }
    following = {a: b for a, b in edges if (b, a) not in edges}
    path = [min(following)]
    while following[path[-1]] != path[0]:
        path.append(following[path[-1]])
    return path


def _corners(rng: np.random.Generator, path: list[tuple[int, int]]) -> Line:
    """[C]: the outline on an uneven grid, with corners moved and some dropped."""
    steps = np.array(path) - np.min(path, axis=0)
    grid = np.cumsum(rng.uniform(*CELL, (2, steps.max() + 1)), axis=1)
    corners = grid[0][steps[:, 0]] + 1j * grid[1][steps[:, 1]]
    corners += rng.uniform(-1.2, 1.2, len(corners)) + 1j * rng.uniform(-1.2, 1.2, len(corners))
    straight_on = (steps - np.roll(steps, 1, axis=0) == np.roll(steps, -1, axis=0) - steps).all(axis=1)
    return corners[rng.random(len(corners)) > np.where(straight_on, 0.5, 0.1)]


def _width(rng: np.random.Generator, points: int) -> Array:
    """[points]: a width that varies slowly along the lap."""
    turn = np.linspace(0, 2 * np.pi, points, endpoint=False)
    waves = np.arange(1, 2 + points * STEP // 20)
    wave = np.cos(np.outer(turn, waves) + rng.uniform(0, 2 * np.pi, len(waves))) @ rng.normal(size=len(waves))
    middle = rng.uniform(0.3, 0.7)
    return WIDTH[0] + (WIDTH[1] - WIDTH[0]) * (middle + 0.3 * wave / np.abs(wave).max())


def _drivable(line: Line, width: Array) -> bool:
    """Whether no turn is too tight, there are left and right turns, and the track stays clear of itself."""
    bend = _curvature(line)
    tight = np.abs(bend).max() * RADIUS > 1 or (np.abs(bend) * (INNER_RADIUS + width / 2)).max() > 1
    if tight or min(bend.max(), -bend.min()) < 0.15:
        return False
    # A quarter of the points is a metre apart, close enough to judge distances of several metres.
    line, width = line[::2], width[::2]
    gap = np.abs(line[:, None] - line) - (width[:, None] + width) / 2
    apart = np.abs(np.arange(len(line))[:, None] - np.arange(len(line)))
    far = np.minimum(apart, len(line) - apart) * 2 * STEP > NEIGHBOURS
    return bool(gap[far].min() > FREE_SPACE)


def _start(line: Line) -> int | None:
    """The middle of the straightest 8 m, or None if even these bend."""
    bends = maximum_filter1d(np.abs(_curvature(line)), round(8 / STEP) + 1, mode="wrap")
    return int(bends.argmin()) if bends.min() < 0.06 else None


def _cones(rng: np.random.Generator, side: Line) -> Array:
    """[N, 2]: cones along a side, a little off the line and not quite evenly spaced, as if placed by hand."""
    length = np.abs(np.roll(side, -1) - side).sum()
    gaps = rng.uniform(0.88, 1.12, round(length / CONE_GAP))
    cones = _resampled(side, np.cumsum(gaps / gaps.sum()) - gaps[0] / gaps.sum())
    cones += rng.uniform(-0.04, 0.04, len(cones)) + 1j * rng.uniform(-0.04, 0.04, len(cones))
    return np.stack([cones.real, cones.imag], axis=1)


def _resampled(line: Line, fractions: Array) -> Line:
    closed = np.append(line, line[0])
    travelled = np.concatenate([[0.0], np.abs(np.diff(closed)).cumsum()])
    return np.interp(fractions * travelled[-1], travelled, closed)


def _directions(line: Line) -> Line:
    ahead = np.roll(line, -1) - np.roll(line, 1)
    return ahead / np.abs(ahead)


def _curvature(line: Line) -> Array:
    ahead = np.roll(line, -1) - line
    return np.angle(ahead / np.roll(ahead, 1)) / STEP
