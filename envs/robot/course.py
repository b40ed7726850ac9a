"""The track of the simulated robot: six metres in the shape of a bean, a straight, left turns and a right turn.

And what a robot meets on any such track: where the cones stand, and how far it is from a crash.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from coil_rl.envs.sight import Frame
from coil_rl.envs.track import SIDES, Track, TrackError, resample

Array = NDArray[np.float64]

THIN, THICK = 0.020, 0.045  # m, radius of a cone on the left and on the right
# m: half the width, between the middles of the cones; and the radius of all turns.
HALF_WIDTH = 0.18
RADIUS = 0.58
RIGHT_TURN = np.pi / 3
CONE_GAP = 0.23
STEP = 0.005  # m, of lines that are sampled

OUTLINE = (0.20, 0.12)  # m, length and width of the robot
ON_THE_LINE = 0.02  # m: the middle of the robot this close to a boundary has left the track
FAR = 1e3  # m


@cache
def robot_track() -> Track:
    """The track, in the robot's own metres: 6 m a lap, driven anticlockwise, starting half-way along a straight."""
    place, normal = _centre_line()
    left, right = (_cones(place + sign * HALF_WIDTH * normal) for sign in (1, -1))
    return Track("robot (simulated)", left, right)


def robot_tracks(scale: float = 1.0) -> list[Track]:
    """The robot's track, as a list of one.

    Args:
        scale: times its size: at 7 a car of the cone world drives where the robot does.
    """
    track = robot_track()
    return [track if scale == 1 else Track(track.name, track.left * scale, track.right * scale)]


def track_notes(track: Track) -> dict[str, str]:
    """A track as notes for a recording, which `noted_track` reads."""
    places = {"left": track.left.tolist(), "right": track.right.tolist(), "start": track.start}
    return {"name": track.name, **{key: json.dumps(value) for key, value in places.items()}}


def noted_track(notes: Mapping[str, str]) -> Track:
    """The track of `track_notes`; the notes of other programs need `left` and `right`, each [[x, y], ...] m.

    Raises:
        TrackError: in one sentence, what is wrong with the notes.
    """
    try:
        left, right, start = (json.loads(notes.get(key, "null")) for key in ("left", "right", "start"))
        rings = [np.array(ring, dtype=np.float64).reshape(-1, 2) for ring in (left, right)]
    except (ValueError, TypeError) as error:
        raise TrackError(f"The track's cones cannot be read ({error}); note each side as [[x, y], ...] in m.") from None
    return Track(notes.get("name", "track"), left=rings[0], right=rings[1], start=start)


class RobotCourse:
    """Where everything stands on each of T tracks, and how far robots are from a crash there.

    Args:
        tracks: in the robot's own metres.

    Example:
        >>> course = RobotCourse([robot_track()])
        >>> clearance, _ = course.clearance(torch.tensor([0]), torch.tensor([robot_track().start]).t())
        >>> round(clearance.item(), 2)
        0.08
    """

    def __init__(self, tracks: Sequence[Track]) -> None:
        stands = [cones_of(track) for track in tracks]
        # What a track has fewer of is filled up far away.
        self.cones = _stacked([place for place, _ in stands], FAR)  # [2, T, M] m
        self.radius = _stacked([radius.unsqueeze(0) for _, radius in stands], 0.0)[0]  # [T, M] m
        lines = ([torch.tensor(track.boundary(side, STEP).T) for track in tracks] for side in SIDES)
        self.boundaries = [_stacked(of_side, FAR) for of_side in lines]  # [2, T, points] m each

    def clearance(self, track: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """How far robots are from a crash: their outline from a cone, their middle from the line between two.

        Args:
            track: [B], on which each is.
            pose: [3, B] m, m, radians.

        Returns:
            [B] m, zero or less is a crash; and how far their middles are from the left and the right boundary, [2, B].
        """
        stand, radius = self.cones[:, track].transpose(1, 2), self.radius[track].t()
        beyond = Frame(pose).to_car(stand).abs() - torch.tensor(OUTLINE).view(2, 1, 1) / 2
        to_cone = (beyond.clamp(min=0).norm(dim=0) - radius).amin(0)
        place = pose[:2].unsqueeze(-1)
        to_boundaries = torch.stack([(line[:, track] - place).norm(dim=0).amin(-1) for line in self.boundaries])
        return torch.minimum(to_cone, to_boundaries.amin(0) - ON_THE_LINE), to_boundaries


def cones_of(track: Track, *, left: bool = True, right: bool = True) -> tuple[Tensor, Tensor]:
    """The cones of a robot's track: centres [2, M] m and radii [M] m, thin ones on the left and thick on the right."""
    chosen = [(ring, size) for ring, size, on in ((track.left, THIN, left), (track.right, THICK, right)) if on]
    if not chosen:
        raise ValueError("cones_of a track with neither left nor right leaves no cone; choose one side or both")
    place = torch.as_tensor(np.vstack([ring for ring, _ in chosen]).T.copy(), dtype=torch.float32)
    return place, torch.cat([torch.full((len(ring),), size) for ring, size in chosen])


def middle_line(track: Track, spacing: float) -> Array:
    """Points half-way between the boundaries of a track, evenly spaced, from the start on: [T, 2] m."""
    middle = track.middle(STEP)
    middle = np.roll(middle, -int(((middle - np.array(track.start[:2])) ** 2).sum(1).argmin()), axis=0)
    return resample(middle, spacing)


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
    return resample(ring, length / round(length / CONE_GAP))


def _stacked(tables: Sequence[Tensor], padding: float) -> Tensor:
    """Tables [D, any] as one, [D, T, most]."""
    most = max(table.shape[1] for table in tables)
    wide = torch.full((len(tables[0]), len(tables), most), padding)
    for index, table in enumerate(tables):
        wide[:, index, : table.shape[1]] = table
    return wide
