"""Sections of a track: straight, left turn, right turn, turn entry and turn exit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from coil_rl.envs.track import AS_COMPLEX, Track, resample

Array = NDArray[np.float64]

SECTIONS = ("straight", "left", "right", "entry", "exit")
STRAIGHT, LEFT, RIGHT, ENTRY, EXIT = range(len(SECTIONS))
SMOOTHING = 1.0  # m


def smooth_line(track: Track, spacing: float = 0.25, smoothing: float = SMOOTHING) -> Array:
    """Return the line half-way between the boundaries, smoothed over single cones: [P, 2] m, closed, from the start.

    The points are about `spacing` m apart. `smoothing` is the standard deviation s of a Gaussian filter in m; a turn of
    radius R becomes s^2 / 2R smaller.
    """
    return np.asarray(gaussian_filter1d(resample(track.middle(), spacing), smoothing / spacing, axis=0, mode="wrap"))


def curvature(line: Array) -> Array:
    """Return the curvature [P] in 1/m of a closed line [P, 2], positive in left turns."""
    edge = (np.roll(line, -1, axis=0) - line) @ AS_COMPLEX
    turn = np.angle(edge * np.roll(edge, 1).conj())
    return np.asarray(2 * turn / (np.abs(edge) + np.abs(np.roll(edge, 1))))


def classify(line: Array, turn_radius: float = 10.0, approach: float = 4.0) -> NDArray[np.int64]:
    """Return the section of each point of a closed line [P, 2] m: indices in SECTIONS, [P].

    A turn is curved more than a circle of `turn_radius` m. An entry is the last `approach` m before a turn, an exit the
    first ones after it; between two turns that are close the exit of the first ends half-way.
    """
    bend = curvature(line)
    turning = np.flatnonzero(np.abs(bend) * turn_radius > 1)
    section = np.full(len(line), STRAIGHT)
    if len(turning):
        index, count = np.arange(len(line)), len(line)
        step = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1).mean()
        to_next = np.append(turning, turning[0] + count)[np.searchsorted(turning, index)] - index
        since_last = index - np.append(turning[-1] - count, turning)[np.searchsorted(turning, index, side="right")]
        section[(since_last < to_next) & (since_last * step <= approach)] = EXIT
        section[(to_next <= since_last) & (to_next * step <= approach)] = ENTRY
        section[turning] = np.where(bend[turning] > 0, LEFT, RIGHT)
    return section


class TrackSections:
    """Lookup of the section of a track in which a car is, by the nearest point of the middle line.

    Cars refer to tracks by index; `turn_radius` and `approach` are those of `classify`, in m.

    Attributes:
        lines: the middle lines, [P, 2] m each.
        sections: of their points, [P] each, indices in SECTIONS.
    """

    def __init__(
        self,
        tracks: Sequence[Track],
        *,
        turn_radius: float = 10.0,
        approach: float = 4.0,
        device: torch.device | str = "cpu",
    ) -> None:
        self.tracks = list(tracks)
        self.lines = [smooth_line(track) for track in tracks]
        self.sections = [classify(line, turn_radius, approach) for line in self.lines]
        points = np.full((len(self.lines), max(map(len, self.lines)), 2), 1e6)  # padded with points far away
        section = np.zeros(points.shape[:2], dtype=np.int64)
        for index, (line, of_points) in enumerate(zip(self.lines, self.sections, strict=True)):
            points[index, : len(line)], section[index, : len(line)] = line, of_points
        self._points = torch.as_tensor(points, dtype=torch.float32, device=device)
        self._section = torch.as_tensor(section, device=device)

    def nearest(self, track: Tensor, position: Tensor) -> Tensor:
        """Return the nearest point of the middle line [B], for tracks [B] and positions [B, 2] m."""
        return (self._points[track] - position.unsqueeze(-2)).square().sum(-1).argmin(-1)

    def section(self, track: Tensor, position: Tensor) -> Tensor:
        """Return the section as an index in SECTIONS [B], for tracks [B] and positions [B, 2] m."""
        return self.section_at(track, self.nearest(track, position))

    def section_at(self, track: Tensor, point: Tensor) -> Tensor:
        """Return the section as an index in SECTIONS [B], for tracks [B] and points of their middle lines [B]."""
        return self._section[track, point]
