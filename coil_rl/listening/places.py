"""Kinds of places along a track: straight, left and right turn, entry and exit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from coil_rl.envs.track import AS_COMPLEX, Track, resample

Array = NDArray[np.float64]

PLACES = ("straight", "left", "right", "entry", "exit")
STRAIGHT, LEFT, RIGHT, ENTRY, EXIT = range(len(PLACES))
SMOOTHING = 1.0  # m


def smooth_line(track: Track, spacing: float = 0.25, smoothing: float = SMOOTHING) -> Array:
    """The line half-way between a track's boundaries, without the jitter of single cones.

    Args:
        track: the track.
        spacing: distance of its points in m, but for what rounding to a whole number of them takes.
        smoothing: standard deviation of the mean over neighbours in m; it takes s^2 / 2R off a turn of radius R.

    Returns:
        [P, 2] m, a closed line in driving order from the first cones; the first point is not repeated.
    """
    return np.asarray(gaussian_filter1d(resample(track.middle(), spacing), smoothing / spacing, axis=0, mode="wrap"))


def curvature(line: Array) -> Array:
    """Curvature [P] in 1/m of a closed line [P, 2], positive where it turns left."""
    edge = (np.roll(line, -1, axis=0) - line) @ AS_COMPLEX
    turn = np.angle(edge * np.roll(edge, 1).conj())
    return np.asarray(2 * turn / (np.abs(edge) + np.abs(np.roll(edge, 1))))


def kinds(line: Array, turn_radius: float = 10.0, approach: float = 4.0) -> NDArray[np.int64]:
    """The kind of place of each point of a closed line: its index in PLACES.

    A turn is where the line is curved more than a circle of `turn_radius`; an entry the last metres before a turn, an
    exit the first ones after; between two turns that are near each other the exit of the first ends half-way.

    Args:
        line: [P, 2] m.
        turn_radius: in m.
        approach: length of entries and exits in m.

    Returns:
        [P].
    """
    bend = curvature(line)
    turning = np.flatnonzero(np.abs(bend) * turn_radius > 1)
    kind = np.full(len(line), STRAIGHT)
    if len(turning):
        here, around = np.arange(len(line)), len(line)
        step = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1).mean()
        ahead = np.append(turning, turning[0] + around)[np.searchsorted(turning, here)] - here
        behind = here - np.append(turning[-1] - around, turning)[np.searchsorted(turning, here, side="right")]
        kind[(behind < ahead) & (behind * step <= approach)] = EXIT
        kind[(ahead <= behind) & (ahead * step <= approach)] = ENTRY
        kind[turning] = np.where(bend[turning] > 0, LEFT, RIGHT)
    return kind


class Places:
    """Where on its track a car is, by the nearest point of the middle line.

    Args:
        tracks: a car names its own by its place in this list.
        turn_radius: m, a turn is tighter.
        approach: m, length of entries and exits.
        device: of the cars.

    Attributes:
        lines: the middle lines, [P, 2] m each.
        kinds: of their points, [P] each, indices in PLACES.

    Raises:
        ValueError: if a length is not positive.

    Example:
        >>> import torch
        >>> from coil_rl.envs import shipped_tracks
        >>> places = Places(shipped_tracks("test"))
        >>> start = torch.tensor([places.tracks[0].start[:2]])
        >>> PLACES[places.kind(torch.tensor([0]), start)]
        'exit'
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        *,
        turn_radius: float = 10.0,
        approach: float = 4.0,
        device: torch.device | str = "cpu",
    ) -> None:
        for name, value in {"turn_radius": turn_radius, "approach": approach}.items():
            if not value > 0:
                raise ValueError(f"{name}={value} must be more than 0")
        self.tracks = list(tracks)
        self.lines = [smooth_line(track) for track in tracks]
        self.kinds = [kinds(line, turn_radius, approach) for line in self.lines]
        most = max(map(len, self.lines))
        points = np.full((len(self.lines), most, 2), 1e6)
        kind = np.zeros((len(self.lines), most), dtype=np.int64)
        for index, (line, of_line) in enumerate(zip(self.lines, self.kinds, strict=True)):
            points[index, : len(line)], kind[index, : len(line)] = line, of_line
        self._points = torch.as_tensor(points, dtype=torch.float32, device=device)
        self._kind = torch.as_tensor(kind, device=device)

    def nearest(self, track: Tensor, position: Tensor) -> Tensor:
        """Which point of its track's middle line each car is at: [B], for tracks [B] and positions [B, 2] m."""
        return (self._points[track] - position.unsqueeze(-2)).square().sum(-1).argmin(-1)

    def kind(self, track: Tensor, position: Tensor) -> Tensor:
        """The kind of place where each car is: [B], indices in PLACES, for tracks [B] and positions [B, 2] m."""
        return self._kind[track, self.nearest(track, position)]
