"""A track as if it were straight: where lines differ, of which a map shows little."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from coil_rl.envs.track import Track
from coil_rl.listening.sections import classify, smooth_line

Array = NDArray[np.float64]

SPACING = 0.05  # m
SMOOTHING = 0.3  # m; more would lie inside of turns


class Straightened:
    """Places on a track by how far they are along its middle line, and how far to the left of it.

    Args:
        track: the track.

    Attributes:
        line: [P, 2] m, the middle line from the first cones on.
        along: [P] m, how far its points are along it.
        kinds: [P], of its places, as `coil_rl.listening.sections.classify`.
        length: m, of a lap of it.

    Example:
        >>> import numpy as np
        >>> from coil_rl.envs import shipped_tracks
        >>> straight = Straightened(shipped_tracks("test")[0])
        >>> along, aside = straight(straight.line[:100])
        >>> bool(np.allclose(along, straight.along[:100]) and np.allclose(aside, 0))
        True
    """

    def __init__(self, track: Track) -> None:
        self.line = smooth_line(track, SPACING, SMOOTHING)
        edges = np.roll(self.line, -1, axis=0) - self.line
        lengths = np.linalg.norm(edges, axis=1)
        self.along: Array = np.cumsum(lengths) - lengths
        self.length = float(lengths.sum())
        self.kinds = classify(smooth_line(track, SPACING))
        # Across a point the direction is that from the one before to the one after.
        ahead = edges + np.roll(edges, 1, axis=0)
        self._ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        self._tree = cKDTree(self.line)

    def __call__(self, places: ArrayLike) -> tuple[Array, Array]:
        """Straighten places.

        Args:
            places: [N, 2] m.

        Returns:
            [N] m along the middle line, from 0 to its length; and [N] m to the left of it.
        """
        places = np.asarray(places, dtype=np.float64).reshape(-1, 2)
        nearest = self._tree.query(places)[1]
        off, ahead = places - self.line[nearest], self._ahead[nearest]
        along = (self.along[nearest] + (off * ahead).sum(1)) % self.length
        return along, ahead[:, 0] * off[:, 1] - ahead[:, 1] * off[:, 0]
