"""What stops a car that drives by its scans: the rules, and the memory that they need.

Each rule is a method that returns the reason to stop, or None. Time comes from a steady clock, one
that nobody sets, in seconds; the stamps of scans come from the scanner and are only compared with
one another.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import KW_ONLY, dataclass

import numpy as np
from numpy.typing import NDArray

from coil_rl.ranges import Positive, Share, checked

INTERVALS = 6  # between scans, of which the median is the rate
NEAR = 1.5  # m, ranges that change as the car moves
ORDERED = 6  # last scans with cones of both sides
FEWEST_NEAR = 10  # ranges by which a scan tells whether the car moves


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan of a LiDAR.

    Args:
        stamp: s, start of the scan by the scanner's clock.
        ranges: [P] m; what is not finite or outside the scanner's range is no return.
        angles: [P] radians, bearings of the ranges, ascending or descending.
        range_min: m, of the scanner.
        range_max: m, of the scanner.
    """

    stamp: float
    ranges: NDArray[np.float32]
    angles: NDArray[np.floating]
    range_min: float = 0.15
    range_max: float = 12.0

    def returns(self) -> NDArray[np.float32]:
        """Return the ranges, infinite where there is no return [P].

        A range of 0 is no return either: it is the code for it of many scanners.
        """
        ranges = np.asarray(self.ranges, np.float32)
        inside = (ranges >= np.float32(self.range_min)) & (ranges <= np.float32(self.range_max))
        return np.where(inside & (ranges > 0), ranges, np.float32(np.inf))


@checked
@dataclass(frozen=True)
class Limits:
    """When a car is stopped.

    Args:
        rate: scans per second for which the policy was trained.
        rate_tolerance: share by which the median rate of the last scans may differ.
        longest_gap: s between two scans.
        blind: s without a scan in which both boundaries are seen.
        fewest_returns: share of a scan's beams that must have a return.
        window: s over which the car's motion is compared with its commands.
        speed_tolerance: share of the commanded speed by which the measured one may differ.
        turn_tolerance: radians/s by which the measured turn rate may differ.
        still: share of the way between two scans; the car stands if ranges change by less.
        late: turns by which a scan may come later than the quickest one, as from a queue.

    Raises:
        ValueError: for a value outside its range.
    """

    rate: Positive
    _: KW_ONLY
    rate_tolerance: Positive = 0.25
    longest_gap: Positive = 0.5
    blind: Positive = 2.0
    fewest_returns: Share = 0.02
    window: Positive = 1.5
    speed_tolerance: Positive = 0.5
    turn_tolerance: Positive = 0.3
    still: Share = 0.2
    late: Positive = 2.0

    def __post_init__(self) -> None:
        if self.longest_gap <= 1 / self.rate:
            raise ValueError(
                f"longest_gap={self.longest_gap} s must be more than the time between two scans, "
                f"{1 / self.rate:.3f} s at {self.rate:g} scans per second"
            )


class Watchdog:
    """The rules with their memory.

    Args:
        limits: of the rules.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.forget()

    def forget(self) -> None:
        """Begin anew, as before the first scan."""
        self.stamps: deque[float] = deque(maxlen=INTERVALS + 1)
        self.arrivals: deque[float] = deque(maxlen=INTERVALS + 1)
        self.quickest = math.inf  # s between stamp and arrival, on two clocks
        self.ordered: deque[bool] = deque(maxlen=ORDERED)  # whether the left cones lay left
        self.seen = -math.inf  # when both boundaries were seen last
        self.last: NDArray[np.float32] | None = None  # ranges of the last scan
        self.stood = 0.0  # s for which the scans have not changed although the car should move
        self.motions: deque[tuple[float, float, float]] = deque()  # time and differences

    def of_scan(self, scan: Scan, now: float) -> str | None:
        """Return why a scan cannot be driven by: its content, its stamp, or when it came.

        Args:
            scan: the scan; it is remembered if nothing is wrong with it.
            now: s, when it came.
        """
        reason = self._of_content(scan) or self._of_stamp(scan) or self.of_time(now)
        if reason is None:
            self.stamps.append(scan.stamp)
            self.arrivals.append(now)
            reason = self._of_age(now - scan.stamp) or self._of_rate()
        return reason

    def _of_age(self, age: float) -> str | None:
        self.quickest = min(self.quickest, age)
        later = age - self.quickest
        if later > self.limits.late / self.limits.rate:
            return (
                f"scans that come late: {later:.2f} s later than the quickest one, as from a queue"
            )
        return None

    def _of_content(self, scan: Scan) -> str | None:
        if np.ndim(scan.ranges) != 1 or not np.size(scan.ranges):
            return "invalid scan: it has no ranges"
        beams, angles = np.size(scan.ranges), np.asarray(scan.angles, np.float64)
        before = beams if self.last is None else len(self.last)
        if angles.shape != (beams,):
            return f"invalid scan: {angles.size} bearings for {beams} ranges"
        limits_known = math.isfinite(scan.range_min) and math.isfinite(scan.range_max)
        if not (limits_known and np.isfinite(angles).all()):
            return "invalid scan: its angles or its range are not finite"
        if abs(angles[-1] - angles[0]) > 2 * math.pi + 1e-3 or not _one_way(angles):
            return "invalid scan: its bearings do not go around once"
        if abs(beams - before) > 0.1 * before:
            return f"invalid scan: {beams} beams instead of {before}"
        returns = scan.returns()
        share = float(np.isfinite(returns).mean())
        if share < self.limits.fewest_returns:
            return f"invalid scan: {share:.1%} of its beams have a return"
        if self.last is not None and np.array_equal(returns, self.last):
            return "invalid scan: it repeats the one before to the last digit"
        return None

    def _of_stamp(self, scan: Scan) -> str | None:
        if not math.isfinite(scan.stamp):
            return "stamp that is not finite"
        if self.stamps and scan.stamp <= self.stamps[-1]:
            return "stamp that does not rise"
        if self.stamps and scan.stamp - self.stamps[-1] > self.limits.longest_gap:
            return f"gap of {scan.stamp - self.stamps[-1]:.2f} s between the stamps of two scans"
        return None

    def of_time(self, now: float) -> str | None:
        """Return why the car stops between two scans: too much time since the last one.

        Args:
            now: s.
        """
        if not math.isfinite(now) or (self.arrivals and now < self.arrivals[-1]):
            return "steady clock that goes back"
        if self.arrivals and now - self.arrivals[-1] > self.limits.longest_gap:
            return f"gap of {now - self.arrivals[-1]:.2f} s since the last scan"
        return None

    def _of_rate(self) -> str | None:
        if len(self.stamps) <= INTERVALS:
            return None
        limits = self.limits
        for name, times in (("arrive", self.arrivals), ("are stamped", self.stamps)):
            rate = 1 / max(float(np.median(np.diff(times))), 1e-9)
            if abs(rate / limits.rate - 1) > limits.rate_tolerance:
                return (
                    f"rate: scans {name} {rate:.1f} times per second, the policy was trained for "
                    f"{limits.rate:.1f}"
                )
        return None

    def of_view(
        self, valid: NDArray[np.bool_], ordered: NDArray[np.bool_], now: float
    ) -> str | None:
        """Return why the car stops by what it sees: no boundaries for too long, or the wrong ones.

        Args:
            valid: [2], whether each side is valid in this scan.
            ordered: [1], whether the left cones lie left; [0] without cones of both sides.
            now: s.
        """
        self.ordered.extend(ordered.tolist())
        if bool(valid.all()) and bool(ordered.all()):
            self.seen = now
        wrong, begins = self.ordered.count(False), self.seen == -math.inf
        if wrong > ORDERED / 2 or (begins and wrong):
            return (
                f"scans that are mirrored or turned: left cones right of the right ones in {wrong} "
                f"of the last {len(self.ordered)}, see perception.laser_yaw"
            )
        if begins:
            return "no view of both boundaries yet"
        if now - self.seen > self.limits.blind:
            return f"no view of both boundaries for {now - self.seen:.1f} s"
        return None

    def of_scene(self, scan: Scan, way: float) -> str | None:
        """Return why the car stops by its scans: they do not change, although it should move.

        Args:
            scan: the scan; it is remembered for the next one.
            way: m that the car was sent since the last one.
        """
        ranges = scan.returns()
        last, self.last = self.last, ranges
        if last is None or len(last) != len(ranges) or len(self.stamps) < 2:
            return None
        near = (ranges < NEAR) & (last < NEAR)
        moves = near.sum() < FEWEST_NEAR or (
            float(np.median(np.abs(ranges[near] - last[near]))) >= self.limits.still * way
        )
        passed = self.stamps[-1] - self.stamps[-2]
        self.stood = 0.0 if way <= 0 or moves else self.stood + passed
        if self.stood > self.limits.window:
            return f"car that does not follow: the scans stand still for {self.stood:.1f} s"
        return None

    def of_motion(
        self, commanded: tuple[float, float], measured: tuple[float, float], now: float
    ) -> str | None:
        """Return why the car stops by its odometry: it does not do what it is told.

        Args:
            commanded: m/s and radians/s.
            measured: m/s and radians/s.
            now: s.
        """
        if not all(map(math.isfinite, measured)):
            return "odometry that is not finite"
        self.motions.append((now, measured[0] - commanded[0], measured[1] - commanded[1]))
        window, limits = self.limits.window, self.limits
        if now - self.motions[0][0] < window:
            return None
        while now - self.motions[0][0] > window:
            self.motions.popleft()
        speed, turn = np.mean([each[1:] for each in self.motions], axis=0)
        if abs(speed) > limits.speed_tolerance * commanded[0]:
            return f"car that does not follow: its speed is off by {speed:+.2f} m/s"
        if abs(turn) > limits.turn_tolerance:
            return f"car that does not follow: its turn rate is off by {turn:+.2f} radians/s"
        return None

    def of_odometry(self, now: float) -> str | None:
        """Return why the car stops: odometry that there was has ended.

        Args:
            now: s.
        """
        if self.motions and now - self.motions[-1][0] > self.limits.window:
            return f"no odometry for {now - self.motions[-1][0]:.1f} s"
        return None


def _one_way(angles: NDArray[np.float64]) -> bool:
    """Return whether bearings all rise, or all fall."""
    steps = np.diff(angles)
    return bool((steps > 0).all() or (steps < 0).all())
