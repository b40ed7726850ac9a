"""Independent implementation of the cone world for one car, in plain NumPy and SciPy.

It uses no code of `coil_rl`. Every step tests every cone of the track.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Curve = Callable[[Array], Array]

MAX_STEERING = np.deg2rad(80)
HALF_FIELD_OF_VIEW = np.deg2rad(60)
KEPT_CONES = 16
SAMPLES = 5
FINISH_RADIUS = 0.625
TARGET_REACHED = 0.625
PAIR_DISTANCE = 4.0
CONE_RADIUS = 0.4
BOUNDARY_MARGIN = 0.25
RECENT = np.exp(-0.1 * np.arange(20)) / np.exp(-0.1 * np.arange(20)).sum()


def merge(points: Array) -> tuple[Array, Array]:
    """Merge consecutive points less than a micrometre apart to one point of their total weight."""
    first = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) >= 1e-6])
    return points[first], np.bincount(np.cumsum(first) - 1).astype(float)


def chord_length(points: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def fit_cubic(points: Array, smoothing: float) -> tuple[Array, Curve]:
    """Fit the natural cubic smoothing spline by chord length.

    Returns the parameters of the points, and the curve. Least squares of weight * |y - f|^2 +
    smoothing * integral |f''|^2: with the second derivatives R^-1 Q' f at the inner points, the
    integral is |L^-1 Q' f|^2, where R = L L'.
    """
    points, weights = merge(points)
    u = chord_length(points)
    if len(points) <= 2:
        return (
            u,
            lambda at: (
                points[0] + np.multiply.outer(at, (points[-1] - points[0]) / max(u[-1], 1e-12))
            ),
        )
    h = np.diff(u)
    n = len(u)
    second = np.zeros((n - 2, n))
    row = np.arange(n - 2)
    second[row, row], second[row, row + 1], second[row, row + 2] = (
        1 / h[:-1],
        -1 / h[:-1] - 1 / h[1:],
        1 / h[1:],
    )
    gram = np.diag((h[:-1] + h[1:]) / 3) + np.diag(h[1:-1] / 6, 1) + np.diag(h[1:-1] / 6, -1)
    rough = np.sqrt(smoothing) * solve_triangular(cholesky(gram, lower=True), second, lower=True)
    root = np.sqrt(weights)[:, None]
    target = np.vstack([root * points, np.zeros((n - 2, 2))])
    values = np.linalg.lstsq(np.vstack([np.diag(root[:, 0]), rough]), target)[0]
    return u, CubicSpline(u, values, bc_type="natural")


def fit_parabola(points: Array) -> tuple[Array, Curve]:
    """Fit the least-squares parabola by chord length, a line for two points."""
    u = chord_length(points)
    degree = 1 if len(points) == 2 else 2
    fits = [np.polynomial.Polynomial.fit(u, points[:, axis], degree) for axis in range(2)]
    return u, lambda at: np.stack([fit(at) for fit in fits], axis=-1)


def to_car(pose: Array, points: Array) -> Array:
    x, y = (points - pose[:2]).T
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.stack([cos * x + sin * y, -sin * x + cos * y], axis=1)


def to_world(pose: Array, point: Array) -> Array:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return pose[:2] + np.array([[cos, -sin], [sin, cos]]) @ point


def without_shared(points: Array, tolerance: float = 0.0) -> Array:
    """Drop the points that share a coordinate with a kept one before them."""
    kept: list[Array] = []
    for point in points:
        if not any((np.abs(point - other) <= tolerance).any() for other in kept):
            kept.append(point)
    return np.array(kept).reshape(-1, 2)


def midpoints(left: Array, right: Array) -> Array:
    """Return the midpoints of close left-right pairs, nearest first."""
    middle = (left[:, None] + right) / 2
    middle = middle[np.linalg.norm(left[:, None] - right, axis=-1) < PAIR_DISTANCE]
    return middle[np.argsort(np.linalg.norm(middle, axis=1), kind="stable")]


def guide_action(
    left: Array,
    right: Array,
    steering: float,
    *,
    spline: str = "cubic",
    smoothing: float = 1.0,
    gain: float = 1.0,
) -> float:
    """Return the advice of appendix A.1 for the visible cones, as a fraction of 80 degrees.

    The cones are in the frame of the car, nearest first.
    """
    points = midpoints(left, right)
    if len(points) < 2:
        return steering
    u, curve = fit_cubic(points, smoothing) if spline == "cubic" else fit_parabola(points)
    length = np.linalg.norm(np.diff(curve(u), axis=0), axis=1).sum()
    targets = curve(np.linspace(0, u[-1], 1 + max(1, round(length))))
    distance = np.linalg.norm(targets, axis=1)
    angle = np.arctan2(targets[:, 1], targets[:, 0])
    valid = (distance > TARGET_REACHED) & (np.abs(angle) <= HALF_FIELD_OF_VIEW)
    if not valid.any():
        return steering
    best = np.flatnonzero(valid)[np.argmin(distance[valid])]
    degrees = 160 / np.pi * np.arctan(np.rad2deg(angle[best]) / distance[best] ** 1.8)
    return gain * float(np.clip(degrees, -80, 80)) / 80


class Outcome(NamedTuple):
    """Result of a step."""

    observation: Array
    terms: dict[str, float]
    lap: int
    lap_time: float
    crashed: bool
    clearance: float
    smoothness: float
    terminated: bool
    truncated: bool

    @property
    def reward(self) -> float:
        return sum(self.terms.values())


@dataclass
class OneCar:
    """One car on one track."""

    left: Array
    right: Array
    start: tuple[float, float, float]
    rate: float = 24.0
    spline: str = "cubic"
    smoothing: float = 0.1
    cone_bonus: str = "first_sighting"
    held_steps: int = 0
    time_limit: float = 200.0
    laps: int = 2
    sight: float = 7.0
    hold_boundary: bool = False
    late_observation: bool = False
    finish_in_sight: bool = False
    speed: float = 2.0
    car_length: float = 2.0
    history: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rings = (self.left, self.right)
        self.finish = (self.left[0] + self.right[0]) / 2
        if self.finish_in_sight:
            self.pose = np.array(self.start, dtype=float)
            self.find_visible()
            self.finish = (self.left[min(self.visible[0])] + self.right[min(self.visible[1])]) / 2
        curves = []
        for ring in self.rings:
            closed = np.vstack([ring, ring[:1]])
            u = chord_length(closed)
            curves.append(CubicSpline(u, closed, bc_type="periodic")(np.arange(0, u[-1], 0.002)))
        self.boundary = cKDTree(np.vstack(curves))
        self.reset()

    def reset(self) -> Array:
        self.pose = np.array(self.start, dtype=float)
        self.history = []
        self.steps = 0
        self.lap = 0
        self.lap_start: int | None = None
        self.in_finish = False
        self.rewarded: list[set[int]] = [set(), set()]
        self.before: list[set[int]] = [set(), set()]
        self.samples: list[Array | None] = [None, None]
        self.find_visible()
        self.latest = self.observe()
        return self.latest

    def find_visible(self) -> None:
        """Find the visible cones of each side, nearest first."""
        self.visible: list[list[int]] = []
        for ring in self.rings:
            local = to_car(self.pose, ring)
            distance = np.linalg.norm(local, axis=1)
            angle = np.arctan2(local[:, 1], local[:, 0])
            rows = np.flatnonzero((distance <= self.sight) & (np.abs(angle) <= HALF_FIELD_OF_VIEW))
            self.visible.append([int(i) for i in rows[np.argsort(distance[rows])][:KEPT_CONES]])

    def cones(self) -> tuple[Array, Array]:
        left, right = (
            to_car(self.pose, ring[indices])
            for ring, indices in zip(self.rings, self.visible, strict=True)
        )
        return left, right

    @property
    def steering(self) -> float:
        return self.history[-1] if self.history else 0.0

    def observe(self, entered: bool = True) -> Array:
        parts = []
        for side, (ring, indices) in enumerate(zip(self.rings, self.visible, strict=True)):
            cones = ring[indices]
            if self.hold_boundary:
                cones = without_shared(cones) if entered else cones[:0]
                if entered and len(cones) < 2:
                    self.samples[side] = np.zeros((SAMPLES, 2))
            if len(cones) >= 2:
                if self.spline == "cubic":
                    u, curve = fit_cubic(cones, self.smoothing)
                else:
                    u, curve = fit_parabola(cones)
                self.samples[side] = curve(np.linspace(0, u[-1], SAMPLES))
            samples = self.samples[side]
            if samples is None:
                parts.append(np.zeros(2 * SAMPLES))
                continue
            local = to_car(self.pose, samples)
            distance = np.linalg.norm(local, axis=1)
            degrees = np.rad2deg(np.arctan2(local[:, 1], local[:, 0]))
            both = np.stack([2 * distance / self.sight - 1, degrees / 120], axis=1)
            parts.append(np.clip(both, -1, 1).ravel())
        return np.concatenate(parts)

    def step(self, action: float) -> Outcome:
        if self.steps < self.held_steps:
            action = 0.0
        action = float(np.clip(action, -1, 1))
        newest_first = (self.history[:-21:-1] + [0.0] * 20)[:20]
        roughness = abs(action - float(RECENT @ newest_first))

        self.move(action)
        self.history.append(action)
        self.steps += 1
        lap_time = self.count_laps()
        self.find_visible()
        cone_sides, entered = self.count_new_cones(new_lap=lap_time > 0)
        observation, self.latest = self.latest, self.observe(entered)
        if not self.late_observation:
            observation = self.latest
        to_cone = np.linalg.norm(np.vstack(self.rings) - self.pose[:2], axis=1).min()
        to_boundary = self.boundary.query(self.pose[:2])[0]
        clearance = float(min(to_cone - CONE_RADIUS, to_boundary - BOUNDARY_MARGIN))
        crashed = clearance <= 0
        terms = {
            "finish": 70 - 0.8 * lap_time if lap_time else 0.0,
            "crash": 0.0,
            "cone": 2.5 * cone_sides,
            "smooth": -0.1 * roughness,
            "alive": 0.001,
        }
        if crashed:
            terms = dict.fromkeys(terms, 0.0) | {"crash": -100.0}
        terminated = crashed or self.lap >= self.laps
        return Outcome(
            observation=observation,
            terms=terms,
            lap=self.lap,
            lap_time=lap_time,
            crashed=crashed,
            clearance=clearance,
            smoothness=roughness,
            terminated=terminated,
            truncated=not terminated and self.steps >= round(self.time_limit * self.rate),
        )

    def move(self, action: float) -> None:
        x, y, heading = self.pose
        dt = 1 / self.rate
        x += self.speed * np.cos(heading) * dt
        y += self.speed * np.sin(heading) * dt
        heading += self.speed / self.car_length * np.sin(action * MAX_STEERING) * dt
        self.pose = np.array([x, y, heading])

    def count_laps(self) -> float:
        """Return the time of the lap just completed, else 0."""
        inside = bool(np.linalg.norm(self.pose[:2] - self.finish) < FINISH_RADIUS)
        entered = inside and not self.in_finish
        self.in_finish = inside
        lap_time = 0.0
        if entered:
            if self.lap_start is not None:
                lap_time = (self.steps - self.lap_start) * (1 / self.rate)
                self.lap += 1
            self.lap_start = self.steps
        return lap_time

    def count_new_cones(self, *, new_lap: bool) -> tuple[int, bool]:
        """Return the number of sides with a rewarded cone, and whether a cone came into view."""
        cone_sides, entered = 0, False
        for side in range(2):
            now = set(self.visible[side])
            if new_lap:
                self.rewarded[side] = set()
            known = self.before[side]
            if self.cone_bonus == "first_sighting":
                known = self.rewarded[side]
            cone_sides += bool(now - known)
            entered |= bool(now - self.before[side])
            self.rewarded[side] |= now
            self.before[side] = now
        return cone_sides, entered


@dataclass
class RememberingGuide:
    """The guide with a memory for one car, from its pose and the numbers of the cones in view."""

    rings: tuple[Array, Array]
    oddities: bool = False
    sight: float = 7.0
    gain: float = 1.0

    def __post_init__(self) -> None:
        self.targets: list[Array] = []
        self.passed: list[bool] = []
        self.seen: list[set[int]] = [set(), set()]
        self.chosen: Array | None = None
        self.gate: Array | None = None
        self.poses: list[Array] = []

    def act(self, pose: Array, visible: list[list[int]], steering: float) -> float:
        """Return the advice for a pose and the cones in view of each side, nearest first."""
        self.poses.append(pose)
        if self.oddities and len(self.poses) == 1:
            return 0.0
        target, self.chosen = self.chosen, self.nearest(pose)
        self.place(pose, visible)
        target = target if self.oddities else self.chosen
        if target is None:
            return 0.0 if self.oddities else steering
        ahead, left = to_car(pose, target[None])[0]
        distance = np.hypot(ahead, left)
        if not TARGET_REACHED < distance < self.sight:
            return 0.0 if self.oddities else steering
        return (
            self.gain * 2 / np.pi * np.arctan(np.rad2deg(np.arctan2(left, ahead)) / distance**1.8)
        )

    def nearest(self, pose: Array) -> Array | None:
        earlier = self.poses[-3][:2] if len(self.poses) > 2 else None
        in_circle = (
            earlier is not None
            and self.gate is not None
            and np.linalg.norm(earlier - self.gate) < TARGET_REACHED
        )
        best = None
        for i, target in enumerate(self.targets):
            ahead, left = to_car(pose, target[None])[0]
            distance = np.hypot(ahead, left)
            if in_circle if self.oddities else distance >= self.sight:
                self.passed[i] = False
            self.passed[i] |= distance <= TARGET_REACHED
            visible = distance < self.sight and abs(np.arctan2(left, ahead)) <= HALF_FIELD_OF_VIEW
            if visible and not self.passed[i] and (best is None or distance < best[0]):
                best = distance, target
        return None if best is None else best[1]

    def place(self, pose: Array, visible: list[list[int]]) -> None:
        known = sum(map(len, self.seen))
        for seen, now in zip(self.seen, visible, strict=True):
            seen.update(now)
        if sum(map(len, self.seen)) == known or min(map(len, visible)) < 2:
            return
        left, right = (ring[now] for ring, now in zip(self.rings, visible, strict=True))
        if self.gate is None:
            self.gate = (left[0] + right[0]) / 2
        middle = (left[:, None] + right)[
            np.linalg.norm(left[:, None] - right, axis=-1) < PAIR_DISTANCE
        ] / 2
        middle = middle[np.argsort(np.linalg.norm(middle - pose[:2], axis=1), kind="stable")]
        # Coordinates are those of the frame at the start.
        middle = to_car(self.poses[0], middle)
        if self.oddities:
            middle = without_shared(middle, 5e-3)
        if len(middle) < 2:
            return
        u, curve = fit_parabola(middle)
        for fraction in np.arange(0, 1.01, 0.5 / len(self.seen[0]) ** 0.4):
            target = to_world(self.poses[0], np.asarray(curve(fraction * u[-1])))
            if all(np.linalg.norm(target - other) >= 1 for other in self.targets):
                self.targets.append(target)
                self.passed.append(False)
