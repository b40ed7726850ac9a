"""Laps of a drive from where the robot was: how long each took and how far it was, whatever track it was on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LINE = 0.5  # m to either side of where the drive began
SHORTEST = 1.0  # m; who crosses the line sooner only swayed there
AT_THE_LINE = 1e-3  # m, so that who stands on the line has not crossed it


@dataclass(frozen=True)
class Laps:
    """The laps of a drive, from its start and back to there.

    Attributes:
        seconds: [L], how long each took.
        metres: [L], how far each was.
    """

    seconds: Array
    metres: Array


def laps(poses: Array, seconds: Array) -> Laps:
    """The laps of a drive: it has done one whenever it crosses, forwards, the line across its start.

    Args:
        poses: [N, 3] m, m, radians, in the order of time.
        seconds: [N].

    Example:
        >>> turn = np.linspace(0, 4.2 * np.pi, 500)  # two laps of a circle of 1 m, at 1 m/s
        >>> poses = np.stack([np.sin(turn), 1 - np.cos(turn), turn], axis=1)
        >>> laps(poses, turn).seconds.round(3).tolist()
        [6.283, 6.283]
    """
    x, y, heading = poses[0]
    ahead = (poses[:, 0] - x) * np.cos(heading) + (poses[:, 1] - y) * np.sin(heading) - AT_THE_LINE
    beside = (poses[:, 1] - y) * np.cos(heading) - (poses[:, 0] - x) * np.sin(heading)
    way = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    before = np.flatnonzero((ahead[:-1] <= 0) & (ahead[1:] > 0) & (np.abs(beside[1:]) < LINE))
    # Between two poses it went straight and steadily.
    share = ahead[before] / (ahead[before] - ahead[before + 1])
    when, where = (of[before] + share * (of[before + 1] - of[before]) for of in (seconds, way))
    crossed: list[int] = []
    for number in range(len(before)):
        if not crossed or where[number] - where[crossed[-1]] > SHORTEST:
            crossed.append(number)
    return Laps(np.diff(when[crossed]), np.diff(where[crossed]))
