"""Live driving: a policy turns each scan of a car's LiDAR into a command.

The chain is that of the simulated robot, step for step: perception, memory of the boundaries, the
observation, and the controller with guide, transforms, normaliser and memory inside. Around it are
the rules of `Watchdog`. A car that has not seen both boundaries does not move; a stop latches until
it is lifted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from coil_rl.envs import Perception
from coil_rl.envs.recordings import in_order
from coil_rl.envs.robot import BoundaryMemory
from coil_rl.ranges import Degrees, Positive, checked
from coil_robot.watchdog import Limits, Scan, Watchdog

State = Literal["waiting", "driving", "stopped"]


class Acts(Protocol):
    """What drives: a `Controller` of a run, or any object with these two methods."""

    def reset(self) -> None:
        """Begin an episode."""

    def act(self, observation: Any) -> Any:
        """Return the steering as a fraction of the largest, for the entries of the cone world."""


class Command(NamedTuple):
    """What a car is told.

    Args:
        speed: m/s ahead.
        turn_rate: radians/s to the left.
    """

    speed: float
    turn_rate: float


HALT = Command(0.0, 0.0)


@checked
@dataclass(frozen=True)
class Car:
    """The car that is driven.

    Args:
        speed: m/s.
        car_length: m, distance between the axles.
        max_steering: degrees of an action of 1, at most 90.
        largest_turn_rate: radians/s, of a command; None for that of the largest steering.
    """

    speed: Positive = 0.15
    car_length: Positive = 2 / 7
    max_steering: Degrees = 80.0
    largest_turn_rate: Positive | None = None

    def command(self, action: float) -> Command:
        """Return the command for a steering as a fraction of the largest (equation 100)."""
        steering = torch.tensor(action * math.radians(self.max_steering), dtype=torch.float32)
        turn_rate = float(steering.sin()) * self.speed / self.car_length
        if self.largest_turn_rate is not None:
            turn_rate = min(max(turn_rate, -self.largest_turn_rate), self.largest_turn_rate)
        return Command(self.speed, turn_rate)


@dataclass(frozen=True, eq=False)
class Moment:
    """What happened at a scan, a measured motion or a tick, for the log.

    Attributes:
        now: s of the steady clock.
        state: of the driver afterwards.
        reason: why it stopped, or why it waits; empty while it drives.
        command: that was given.
        scan: that came; None for a tick.
        action: the steering; NaN without one.
        valid: [2], whether each side is valid; None if the scan was not looked at.
        observation: [20]; None if the scan was not looked at.
    """

    now: float
    state: State
    reason: str
    command: Command
    scan: Scan | None = None
    action: float = math.nan
    valid: NDArray[np.bool_] | None = None
    observation: NDArray[np.float32] | None = None


class LiveDriver:
    """Turns scans into commands, and stops by the rules of `Watchdog`.

    Call `scan` for each scan, `tick` as often as you like between them, and `odometry` for each
    measured motion, all from one thread; each returns the command to send now.

    Args:
        controller: a `Controller`, or any object with `act` and `reset`.
        perception: from a scan to cones.
        limits: of the rules.
        car: the car.
        spline: of the boundary estimate, "cubic" or "quadratic".
        smoothing: lambda of the cubic smoothing spline, m^3 in the scale of the cone world.
        log: called with everything that happens.

    Attributes:
        state: "waiting" for a first valid scan, "driving", or "stopped" until `lift`.
        reason: why it stopped, or what it waits for.

    Raises:
        ValueError: for a controller that does not act on the entries of the cone world.

    Example:
        >>> import coil_rl
        >>> from coil_robot import Limits, LiveDriver, setup_of
        >>> controller = coil_rl.open_run("outputs/robot").controller()  # doctest: +SKIP
        >>> setup = setup_of(controller.plant)  # doctest: +SKIP
        >>> driver = LiveDriver(controller, setup.perception, Limits(5.5))  # doctest: +SKIP
        >>> speed, turn_rate = driver.scan(scan, time.monotonic())  # doctest: +SKIP
    """

    def __init__(
        self,
        controller: Acts,
        perception: Perception,
        limits: Limits,
        car: Car | None = None,
        *,
        spline: Literal["cubic", "quadratic"] = "cubic",
        smoothing: float = 0.1,
        log: Callable[[Moment], Any] = lambda moment: None,
    ) -> None:
        self.controller, self.perception, self.car = controller, perception, car or Car()
        self.watchdog, self.log = Watchdog(limits), log
        self.memory = BoundaryMemory(1, spline, smoothing, sight=perception.sight)
        self._begin()
        self._rehearse()
        self._begin()

    def _rehearse(self) -> None:
        """Let the controller act once, so that one that cannot is refused before it drives."""
        cones = torch.zeros(1, 2, self.perception.kept_cones, 2)
        entries, _ = self._entries(cones, torch.zeros(1, 2, dtype=torch.int64))
        action = np.asarray(self.controller.act(entries), dtype=np.float64)
        if action.size != 1:
            raise ValueError(
                f"the controller acts with {action.size} numbers; a car needs one, the steering"
            )

    def _begin(self) -> None:
        """Wait for a first valid scan, with nothing remembered."""
        self.state: State = "waiting"
        self.reason = "no scan yet"
        self.command, self.action = HALT, 0.0
        self.watchdog.forget()
        self.memory.reset(torch.ones(1, dtype=torch.bool))
        self.controller.reset()

    def scan(self, scan: Scan, now: float) -> Command:
        """Return the command after a scan.

        Args:
            now: s of a steady clock, when it came.
        """
        if self.state == "stopped":
            return self._done(now, scan)
        way = self._way(scan)
        reason = self.watchdog.of_scan(scan, now) or self.watchdog.of_scene(scan, way)
        if reason:
            return self._fail(reason, now, scan)
        found, number = self.perception(scan.returns()[None], scan.angles)
        cones, count = torch.from_numpy(found).float(), torch.from_numpy(number)
        entries, valid = self._entries(cones, count, way)
        reason = self.watchdog.of_view(valid, in_order(found, number), now)
        if reason:
            return self._fail(reason, now, scan, valid, entries)
        try:
            action = float(np.asarray(self.controller.act(entries)).reshape(()))
        except Exception as error:  # whatever a policy raises, the car must stop
            return self._fail(f"policy that fails: {error}", now, scan, valid, entries)
        if not math.isfinite(action):
            return self._fail("policy whose action is not finite", now, scan, valid, entries)
        self.action = min(max(action, -1.0), 1.0)
        self.state, self.reason = "driving", ""
        self.command = self.car.command(self.action)
        return self._done(now, scan, valid, entries)

    def tick(self, now: float) -> Command:
        """Return the command between two scans: the last one, unless a rule stops the car.

        Args:
            now: s of the same steady clock.
        """
        if self.state == "driving":
            reason = self.watchdog.of_time(now) or self.watchdog.of_odometry(now)
            if reason:
                return self._fail(reason, now)
        return self.command

    def odometry(self, speed: float, turn_rate: float, now: float) -> Command:
        """Return the command after the motion of the car was measured.

        Args:
            speed: m/s ahead.
            turn_rate: radians/s to the left.
            now: s of the same steady clock.
        """
        if self.state == "driving":
            reason = self.watchdog.of_motion(self.command, (speed, turn_rate), now)
            if reason:
                return self._fail(reason, now)
        return self.command

    def stop(self, reason: str, now: float) -> Command:
        """Stop the car until `lift`; return the command.

        Args:
            now: s of the same steady clock.
        """
        self.state, self.reason, self.command = "stopped", reason, HALT
        return self._done(now)

    def lift(self, now: float) -> None:
        """Lift a stop: the car waits for a first valid scan again.

        Args:
            now: s of the same steady clock.
        """
        self._begin()
        self._done(now)

    def _fail(self, reason: str, now: float, scan: Scan | None = None, *seen: Any) -> Command:
        """Stop for a reason; a car that waits goes on waiting."""
        if self.state == "driving":
            self.state = "stopped"
        else:
            self._begin()
        self.reason, self.command = reason, HALT
        return self._done(now, scan, *seen)

    def _done(
        self,
        now: float,
        scan: Scan | None = None,
        valid: NDArray[np.bool_] | None = None,
        entries: dict[str, Any] | None = None,
    ) -> Command:
        """Log what happened, and return the command."""
        driving = self.state == "driving"
        moment = Moment(
            now,
            self.state,
            self.reason,
            self.command,
            scan,
            self.action if driving and scan is not None else math.nan,
            valid,
            None if entries is None else entries["observation"],
        )
        self.log(moment)
        return self.command

    def _way(self, scan: Scan) -> float:
        """Return the m that the car was sent since the last scan."""
        stamps = self.watchdog.stamps
        passed = scan.stamp - stamps[-1] if stamps else 0.0
        return self.command.speed * min(max(passed, 0.0), self.watchdog.limits.longest_gap)

    def _entries(
        self, cones: torch.Tensor, count: torch.Tensor, way: float = 0.0
    ) -> tuple[dict[str, Any], NDArray[np.bool_]]:
        """Return the entries of the cone world for what is in view, and which sides are valid.

        `motion` is what the last command amounts to, as the car has no other measure of it.
        """
        observation, valid = self.memory(cones, count)
        speed, turn_rate = self.command
        turn = way * turn_rate / speed if speed else 0.0
        chord = self.perception.scale * way * float(np.sinc(turn / (2 * math.pi)))
        motion = [chord * math.cos(turn / 2), chord * math.sin(turn / 2), turn]
        entries = {
            "observation": observation[0].numpy(),
            "cones": cones[0].numpy(),
            "cone_count": count[0].numpy(),
            "steering": np.array([self.action], np.float32),
            "motion": np.array(motion, np.float32),
        }
        return entries, valid[0].numpy()
