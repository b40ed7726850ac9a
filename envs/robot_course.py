"""The track of the simulated robot: six metres in the shape of a bean, a straight, left turns and a right turn."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from coil_rl.envs.track import Track

Array = NDArray[np.float64]

THIN, THICK = 0.020, 0.045  # m, radius of a cone on the left and on the right
# m: half the width, between the middles of the cones; and the radius of all turns.
HALF_WIDTH = 0.18
RADIUS = 0.58
RIGHT_TURN = np.pi / 3
CONE_GAP = 0.23
STEP = 0.005


@cache
def robot_track() -> Track:
    """The track, in the robot's own metres: 6 m a lap, driven anticlockwise, starting half-way along a straight."""
    place, normal = _centre_line()
    left, right = (_cones(place + sign * HALF_WIDTH * normal) for sign in (1, -1))
    return Track("robot (simulated)", left, right)


def robot_tracks() -> list[Track]:
    """The robot's track, as a list of one."""
    return [robot_track()]


def cones_of(track: Track, *, left: bool = True, right: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """The cones of a robot's track: centres [2, M] m and radii [M] m, thin ones on the left and thick on the right."""
    chosen = [(ring, size) for ring, size, on in ((track.left, THIN, left), (track.right, THICK, right)) if on]
    if not chosen:
        raise ValueError("cones_of a track with neither left nor right leaves no cone; choose one side or both")
    place = torch.as_tensor(np.vstack([ring for ring, _ in chosen]).T.copy(), dtype=torch.float32)
    return place, torch.cat([torch.full((len(ring),), size) for ring, size in chosen])


def middle_line(track: Track, spacing: float) -> Array:
    """Points half-way between the boundaries of a track, evenly spaced, from the start on: [T, 2] m."""
    left, right = track.boundary("left", STEP), track.boundary("right", STEP)
    nearest = ((left[:, None] - right) ** 2).sum(-1).argmin(1)
    middle = (left + right[nearest]) / 2
    middle = np.roll(middle, -int(((middle - np.array(track.start[:2])) ** 2).sum(1).argmin()), axis=0)
    return _evenly(middle, spacing)


def _centre_line() -> tuple[Array, Array]:
    """Points along the middle of the track and the directions to the left of it, [T, 2] each."""
    # The lap closes if the straight is as long as the three circles make it.
    straight = 4 * RADIUS * np.sin(RIGHT_TURN / 2)
    around = np.pi + RIGHT_TURN / 2
    half, left, right = (straight / 2, 0.0), (RADIUS * around, 1 / RADIUS), (RADIUS * RIGHT_TURN, -1 / RADIUS)
    pieces = [half, left, right, left, half]
    ends = np.cumsum([length for length, _ in pieces])
    # Each step in the middle of its length: then a turn is as long as it should be, to a fraction of a step.
    steps = round(ends[-1] / STEP)
    at = (np.arange(steps) + 0.5) * ends[-1] / steps
    bend = np.array([bend for _, bend in pieces])[np.searchsorted(ends, at)]
    heading = np.cumsum(bend) * ends[-1] / steps
    place = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0) * ends[-1] / steps
    # What is left open after the lap is rounding of the steps; it is shared out.
    place -= np.outer(np.linspace(0, 1, steps), place[-1])
    return place, np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def _cones(ring: Array) -> Array:
    length = np.linalg.norm(np.diff(ring, axis=0, append=ring[:1]), axis=1).sum()
    return _evenly(ring, length / round(length / CONE_GAP))


def _evenly(ring: Array, spacing: float) -> Array:
    """Points along a closed line [P, 2], the last of them a step of about `spacing` before the first."""
    closed = np.vstack([ring, ring[:1]])
    travelled = np.concatenate([[0], np.linalg.norm(np.diff(closed, axis=0), axis=1).cumsum()])
    at = np.linspace(0, travelled[-1], round(travelled[-1] / spacing), endpoint=False)
    return np.stack([np.interp(at, travelled, axis) for axis in closed.T], axis=1)
