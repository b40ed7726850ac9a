"""Circular and oval tracks of known geometry."""

import numpy as np

from coil_rl.envs import Track


def circle(radius, points=60, clockwise=False):
    angle = np.linspace(0, 2 * np.pi, points, endpoint=False) * (-1 if clockwise else 1)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def ring_track(name, radius, width=2.0):
    """A circular track, anticlockwise."""
    return Track(name, left=circle(radius - width / 2, 24), right=circle(radius + width / 2, 28))


def oval_line(length=40.0, radius=6.0, spacing=0.1):
    """Return an oval around the origin, anticlockwise, the first straight along +x: [P, 2]."""
    straight = np.arange(0, length, spacing)
    turn = np.arange(0, np.pi, spacing / radius)
    forward = np.stack([straight - length / 2, np.full_like(straight, -radius)], axis=1)
    around = np.stack([length / 2 + radius * np.sin(turn), -radius * np.cos(turn)], axis=1)
    half = np.vstack([forward, around])
    return np.vstack([half, -half])


def oval_track(name, clockwise=False, length=10.0, radius=6.0):
    """Return a track 3 m wide along an oval."""
    inner, outer = (oval_line(length, r, spacing=1.5) for r in (radius - 1.5, radius + 1.5))
    if clockwise:
        inner, outer = outer * [1, -1], inner * [1, -1]
    return Track(name, inner, outer)
