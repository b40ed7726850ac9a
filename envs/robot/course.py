"""Tracks of the simulated robot: the 6 m track, its cones, the distance to a crash, and laps.

All lengths are in the robot's own metres. A robot's course is a `Track` as in the cone world; what
is particular here are the radii of the cones, thin ones left and thick ones right, by which the
robot tells the sides apart.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from coil_rl.envs.sight import Frame
from coil_rl.envs.track import SIDES, Array, Track, TrackError, resample
from coil_rl.ranges import NonNegative, checked

Sides = Literal["left", "right", "both"]

THIN, THICK = 0.020, 0.045  # m, radius of a cone on the left and on the right
HALF_WIDTH = 0.18  # m, from the centre line to the middle of a cone
RADIUS = 0.58  # m, of all bends
RIGHT_TURN = np.pi / 3
CONE_GAP = 0.23  # m
STEP = 0.005  # m, spacing of sampled lines

OUTLINE = (0.20, 0.12)  # m, length and width of the robot
BOUNDARY_MARGIN = 0.02  # m, the centre of the robot this close to a boundary has left the track
FAR = 1e3  # m, position of padding

LINE_HALF_WIDTH = 0.5  # m to either side of the start of a drive
SHORTEST_LAP = 1.0  # m, shorter ones are oscillations across the line
LINE_OFFSET = 1e-3  # m, so that a robot that stands on the line has not crossed it


@cache
def robot_track() -> Track:
    """Return the track in the robot's own metres.

    It is a closed line of 6 m with left bends, a right bend and a straight.
    """
    centre, normal = _centre_line()
    sides = []
    for sign in (1, -1):
        ring = centre + sign * HALF_WIDTH * normal
        length = np.linalg.norm(np.diff(ring, axis=0, append=ring[:1]), axis=1).sum()
        sides.append(resample(ring, length / round(length / CONE_GAP)))
    left, right = sides
    return Track("robot (simulated)", left, right)


@checked
def robot_tracks(
    scale: float = 1,
    count: int = 1,
    missing: NonNegative = 0,
    moved: NonNegative = 0,
    seed: int = 0,
) -> list[Track]:
    """Return copies of the robot's track, enlarged and with faults.

    Args:
        scale: factor of all lengths; with 7 the track fits the cars of the cone world.
        count: number of copies.
        missing: probability with which each cone is missing.
        moved: m of the unscaled track, standard deviation of the normal noise by which each cone is
            moved.
        seed: of the missing and moved cones.

    Raises:
        TrackError: for a track with too few cones, or with sides that cross.
    """
    track, generator, tracks = robot_track(), np.random.default_rng(seed), []
    start = (scale * track.start[0], scale * track.start[1], track.start[2])
    for copy in range(count):
        kept = [ring[generator.random(len(ring)) >= missing] for ring in (track.left, track.right)]
        left, right = (
            scale * (ring + moved * generator.standard_normal(ring.shape)) for ring in kept
        )
        name = track.name if copy == 0 else f"{track.name} {copy}"
        tracks.append(Track(name, left, right, start))
    return tracks


def track_notes(track: Track) -> dict[str, str]:
    """Return a track as a metadata record, the inverse of `noted_track`."""
    values = {"left": track.left.tolist(), "right": track.right.tolist(), "start": track.start}
    return {"name": track.name, **{key: json.dumps(value) for key, value in values.items()}}


def noted_track(notes: Mapping[str, str]) -> Track:
    """Return the track of a metadata record.

    Args:
        notes: the record: `left` and `right`, each [[x, y], ...] m as JSON, and if given `start`
            and `name`. Without valid sides, or for sides that make no track, a `TrackError` is
            raised.
    """
    try:
        left, right, start = (
            json.loads(notes.get(key, "null")) for key in ("left", "right", "start")
        )
        rings = [np.array(ring, dtype=np.float64).reshape(-1, 2) for ring in (left, right)]
    except (ValueError, TypeError) as error:
        raise TrackError(
            f"The track's cones cannot be read ({error}); note each side as [[x, y], ...] in m."
        ) from None
    return Track(notes.get("name", "track"), left=rings[0], right=rings[1], start=start)


class RobotCourse:
    """Cones and boundaries of several tracks, and the distance of robots to a crash.

    Args:
        tracks: T tracks in the robot's own metres.

    Attributes:
        cones: centres, [2, T, M] m.
        radius: of the cones, [T, M] m.
        boundaries: of the left and the right side, [2, T, points] m each.
    """

    def __init__(self, tracks: Sequence[Track]) -> None:
        cones = [cones_of(track) for track in tracks]
        self.cones = _stack_padded([centres for centres, _ in cones], FAR)
        self.radius = _stack_padded([radius.unsqueeze(0) for _, radius in cones], 0.0)[0]
        self.boundaries = []
        for side in SIDES:
            lines = [torch.tensor(track.boundary(side, STEP).T) for track in tracks]
            self.boundaries.append(_stack_padded(lines, FAR))

    def clearance(self, track: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distance of robots to a crash, and to both boundaries.

        A crash, a distance of at most 0, is that of the outline into a cone or of the centre into a
        boundary.

        Args:
            track: [B], index of the track of each robot.
            pose: [3, B], m, m and radians.

        Returns:
            The distance to a crash [B] m, and those of the centre to the left and the right
            boundary [2, B] m.
        """
        cones, radius = self.cones[:, track].transpose(1, 2), self.radius[track].t()
        outside = Frame(pose).to_car(cones).abs() - torch.tensor(OUTLINE).view(2, 1, 1) / 2
        to_cone = (_root(_squares(*outside.clamp(min=0))) - radius).amin(0)
        x, y = pose[:2].unsqueeze(-1)
        # The smallest square has the smallest root.
        to_boundaries = _root(
            torch.stack(
                [
                    _squares(line_x[track] - x, line_y[track] - y).amin(-1)
                    for line_x, line_y in self.boundaries
                ]
            )
        )
        return torch.minimum(to_cone, to_boundaries.amin(0) - BOUNDARY_MARGIN), to_boundaries


def _squares(x: Tensor, y: Tensor) -> Tensor:
    return (x * x).add_(y * y)


def _root(squares: Tensor) -> Tensor:
    """Return the square root with the rounding of a norm; that of float32 differs in the end."""
    return squares.double().sqrt().to(squares.dtype)


def cones_of(track: Track, sides: Sides = "both") -> tuple[Tensor, Tensor]:
    """Return the cones of a robot's track, thin ones left and thick ones right.

    Args:
        sides: those whose cones are there.

    Returns:
        Centres [2, M] m and radii [M] m.
    """
    rings = {"left": (track.left, THIN), "right": (track.right, THICK)}
    chosen = [ring for side, ring in rings.items() if sides in (side, "both")]
    centres = torch.as_tensor(np.vstack([ring for ring, _ in chosen]).T.copy(), dtype=torch.float32)
    return centres, torch.cat([torch.full((len(ring),), size) for ring, size in chosen])


def middle_line(track: Track, spacing: float) -> Array:
    """Return evenly spaced points midway between the boundaries of a track: [T, 2] m.

    Args:
        track: the track; the points begin at its start.
        spacing: m, approximate distance of two points.
    """
    middle = track.middle(STEP)
    nearest = ((middle - np.array(track.start[:2])) ** 2).sum(1).argmin()
    return resample(np.roll(middle, -int(nearest), axis=0), spacing)


@dataclass(frozen=True)
class Laps:
    """Duration and length of L completed laps.

    Attributes:
        seconds: [L] s, durations.
        metres: [L] m, lengths.
    """

    seconds: Array
    metres: Array


def laps(poses: Array, seconds: Array) -> Laps:
    """Return the laps of a drive.

    A lap ends where the drive crosses, forwards, the line across its start.

    Args:
        poses: [N, 3], m, m and radians.
        seconds: [N] s, their times.
    """
    x, y, heading = poses[0]
    east, north = poses[:, 0] - x, poses[:, 1] - y
    forward = east * np.cos(heading) + north * np.sin(heading) - LINE_OFFSET
    sideways = north * np.cos(heading) - east * np.sin(heading)
    travelled = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    crosses = (forward[:-1] <= 0) & (forward[1:] > 0) & (np.abs(sideways[1:]) < LINE_HALF_WIDTH)
    before = np.flatnonzero(crosses)
    share = forward[before] / (forward[before] - forward[before + 1])
    time, way = (
        values[before] + share * (values[before + 1] - values[before])
        for values in (seconds, travelled)
    )
    crossings: list[int] = []
    for index in range(len(before)):
        if not crossings or way[index] - way[crossings[-1]] > SHORTEST_LAP:
            crossings.append(index)
    return Laps(np.diff(time[crossings]), np.diff(way[crossings]))


def _centre_line() -> tuple[Array, Array]:
    """Return points on the centre line of the track and its normals to the left, [T, 2] each."""
    # With a straight of this length the three arcs close the lap.
    straight = 4 * RADIUS * np.sin(RIGHT_TURN / 2)
    left_turn = np.pi + RIGHT_TURN / 2
    # Length and curvature of each piece.
    half = (straight / 2, 0.0)
    left = (RADIUS * left_turn, 1 / RADIUS)
    right = (RADIUS * RIGHT_TURN, -1 / RADIUS)
    pieces = [half, left, right, left, half]
    ends = np.cumsum([length for length, _ in pieces])
    # Steps are evaluated at their midpoints: then the length of each bend is exact to a fraction of
    # a step.
    steps = round(ends[-1] / STEP)
    midpoints = (np.arange(steps) + 0.5) * ends[-1] / steps
    curvature = np.array([curvature for _, curvature in pieces])[np.searchsorted(ends, midpoints)]
    heading = np.cumsum(curvature) * ends[-1] / steps
    directions = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    position = np.cumsum(directions, axis=0) * ends[-1] / steps
    # Spread the rounding error that keeps the lap open.
    position -= np.outer(np.linspace(0, 1, steps), position[-1])
    return position, np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def _stack_padded(tables: Sequence[Tensor], padding: float) -> Tensor:
    """Stack tables [D, any] to [D, T, most]."""
    stacked = pad_sequence([table.T for table in tables], padding_value=padding)
    return stacked.permute(2, 1, 0).float().contiguous()
