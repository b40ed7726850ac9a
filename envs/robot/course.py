"""Tracks of the simulated robot: the 6 m track, cone positions and radii, distance to a crash, laps of a drive."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from coil_rl.envs.limits import check_range
from coil_rl.envs.sight import Frame
from coil_rl.envs.track import SIDES, Array, Track, TrackError, resample

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
    """Return the track in the robot's own metres: a closed line of 6 m with left bends, a right bend and a straight."""
    centre, normal = _centre_line()
    sides = []
    for sign in (1, -1):
        ring = centre + sign * HALF_WIDTH * normal
        length = np.linalg.norm(np.diff(ring, axis=0, append=ring[:1]), axis=1).sum()
        sides.append(resample(ring, length / round(length / CONE_GAP)))
    left, right = sides
    return Track("robot (simulated)", left, right)


def robot_tracks(
    scale: float = 1, count: int = 1, missing: float = 0, moved: float = 0, seed: int = 0
) -> list[Track]:
    """Return copies of the robot's track, enlarged by `scale`: with 7 it fits the cars of the cone world.

    Each cone is `missing` with this probability, or `moved` by normal noise of this standard
    deviation in m of the unscaled track. A track with too few cones, or with sides that cross, is a
    `TrackError`.
    """
    check_range(0, missing=missing, moved=moved)
    track, generator, tracks = robot_track(), np.random.default_rng(seed), []
    start = (scale * track.start[0], scale * track.start[1], track.start[2])
    for copy in range(count):
        kept = [ring[generator.random(len(ring)) >= missing] for ring in (track.left, track.right)]
        left, right = (
            scale * (ring + moved * generator.standard_normal(ring.shape)) for ring in kept
        )
        tracks.append(Track(f"{track.name} {copy}".removesuffix(" 0"), left, right, start))
    return tracks


def track_notes(track: Track) -> dict[str, str]:
    """Return a track as a metadata record, the inverse of `noted_track`."""
    values = {"left": track.left.tolist(), "right": track.right.tolist(), "start": track.start}
    return {"name": track.name, **{key: json.dumps(value) for key, value in values.items()}}


def noted_track(notes: Mapping[str, str]) -> Track:
    """Return the track of a metadata record; without valid `left` and `right`, [[x, y], ...] m each, a `TrackError`."""
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
    """Cones and boundaries of T tracks in the robot's own metres, with the distance of robots to a crash."""

    def __init__(self, tracks: Sequence[Track]) -> None:
        cones = [cones_of(track) for track in tracks]
        self.cones = _stack_padded([centres for centres, _ in cones], FAR)  # [2, T, M] m
        self.radius = _stack_padded([radius.unsqueeze(0) for _, radius in cones], 0.0)[
            0
        ]  # [T, M] m
        lines = ([torch.tensor(track.boundary(side, STEP).T) for track in tracks] for side in SIDES)
        self.boundaries = [_stack_padded(side, FAR) for side in lines]  # [2, T, points] m each

    def clearance(self, track: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distance of robots to a crash [B] m, and those of their centres to both boundaries [2, B] m.

        A crash, a distance of at most 0, is that of the outline into a cone or of the centre into a
        boundary. Robots are at poses [3, B] (m, m, radians) on tracks [B].
        """
        cones, radius = self.cones[:, track].transpose(1, 2), self.radius[track].t()
        outside = Frame(pose).to_car(cones).abs() - torch.tensor(OUTLINE).view(2, 1, 1) / 2
        to_cone = (outside.clamp(min=0).norm(dim=0) - radius).amin(0)
        centre = pose[:2].unsqueeze(-1)
        to_boundaries = torch.stack(
            [(line[:, track] - centre).norm(dim=0).amin(-1) for line in self.boundaries]
        )
        return torch.minimum(to_cone, to_boundaries.amin(0) - BOUNDARY_MARGIN), to_boundaries


def cones_of(track: Track, *, left: bool = True, right: bool = True) -> tuple[Tensor, Tensor]:
    """Return the cones of a robot's track: centres [2, M] m and radii [M] m, thin ones left, thick ones right."""
    rings = [
        (ring, size)
        for ring, size, use in ((track.left, THIN, left), (track.right, THICK, right))
        if use
    ]
    if not rings:
        raise ValueError(
            "cones_of a track with neither left nor right has no cone; choose one side or both"
        )
    centres = torch.as_tensor(np.vstack([ring for ring, _ in rings]).T.copy(), dtype=torch.float32)
    return centres, torch.cat([torch.full((len(ring),), size) for ring, size in rings])


def middle_line(track: Track, spacing: float) -> Array:
    """Return evenly spaced points midway between the boundaries of a track, from the start on: [T, 2] m."""
    middle = track.middle(STEP)
    middle = np.roll(
        middle, -int(((middle - np.array(track.start[:2])) ** 2).sum(1).argmin()), axis=0
    )
    return resample(middle, spacing)


@dataclass(frozen=True)
class Laps:
    """Duration and length of L completed laps, [L] each."""

    seconds: Array
    metres: Array


def laps(poses: Array, seconds: Array) -> Laps:
    """Return the laps of a drive with poses [N, 3] m, m, radians at times [N] s.

    A lap ends where the drive crosses, forwards, the line across its start.
    """
    x, y, heading = poses[0]
    forward = (
        (poses[:, 0] - x) * np.cos(heading) + (poses[:, 1] - y) * np.sin(heading) - LINE_OFFSET
    )
    sideways = (poses[:, 1] - y) * np.cos(heading) - (poses[:, 0] - x) * np.sin(heading)
    travelled = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    before = np.flatnonzero(
        (forward[:-1] <= 0) & (forward[1:] > 0) & (np.abs(sideways[1:]) < LINE_HALF_WIDTH)
    )
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
    half, left, right = (
        (straight / 2, 0.0),
        (RADIUS * left_turn, 1 / RADIUS),
        (RADIUS * RIGHT_TURN, -1 / RADIUS),
    )
    pieces = [half, left, right, left, half]
    ends = np.cumsum([length for length, _ in pieces])
    # Steps are evaluated at their midpoints: then the length of each bend is exact to a fraction of
    # a step.
    steps = round(ends[-1] / STEP)
    midpoints = (np.arange(steps) + 0.5) * ends[-1] / steps
    curvature = np.array([curvature for _, curvature in pieces])[np.searchsorted(ends, midpoints)]
    heading = np.cumsum(curvature) * ends[-1] / steps
    position = (
        np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0) * ends[-1] / steps
    )
    # Spread the rounding error that keeps the lap open.
    position -= np.outer(np.linspace(0, 1, steps), position[-1])
    return position, np.stack([-np.sin(heading), np.cos(heading)], axis=1)


def _stack_padded(tables: Sequence[Tensor], padding: float) -> Tensor:
    """Stack tables [D, any] to [D, T, most]."""
    return (
        pad_sequence([table.T for table in tables], padding_value=padding)
        .permute(2, 1, 0)
        .float()
        .contiguous()
    )
