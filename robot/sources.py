"""Drives of a `LiveDriver` on the simulated robot in this process, and on a recording."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from coil_rl.envs import Recording, SimulatedRobotEnv
from coil_rl.envs.robot import RANGE_MAX, RANGE_MIN
from coil_robot.driver import Command, LiveDriver
from coil_robot.watchdog import Scan

TICK = 0.05  # s between two ticks
LARGEST = 1e6  # m


@dataclass
class Drive:
    """What came of a drive.

    Attributes:
        scans: number of scans.
        states: number of scans after which the driver was in each state.
        stops: s since the start and reason of each stop.
        waits: number of scans after which the driver waited, by the reason.
        milliseconds: of CPU for each scan that was driven by.
        laps: completed, of the simulated robot; None where nobody counts them.
        ended: how the drive ended.
    """

    scans: int = 0
    states: Counter[str] = field(default_factory=Counter)
    stops: list[tuple[float, str]] = field(default_factory=list)
    waits: Counter[str] = field(default_factory=Counter)
    milliseconds: list[float] = field(default_factory=list)
    laps: int | None = None
    ended: str = ""


class _Watched:
    """A driver whose stops are noted, and lifted after some time.

    Args:
        driver: of a car.
        lift_after: s after which a stop is lifted; None: never.
        start: s of the clock.
    """

    def __init__(self, driver: LiveDriver, lift_after: float | None, start: float = 0.0) -> None:
        self.driver, self.lift_after, self.start, self.drive = driver, lift_after, start, Drive()
        self.stopped_at: float | None = None

    def scan(self, scan: Scan, now: float) -> Command:
        """Hand a scan to the driver; return its command."""
        self._lift(now)
        begin = time.process_time()
        command = self.driver.scan(scan, now)
        passed = 1000 * (time.process_time() - begin)
        self.drive.scans += 1
        self.drive.states[self.driver.state] += 1
        if self.driver.state == "driving":
            self.drive.milliseconds.append(passed)
        elif self.driver.state == "waiting":
            self.drive.waits[self.driver.reason] += 1
        self.note(now)
        return command

    def ticks(self, since: float, until: float) -> Command:
        """Tick from one time to another; return the last command."""
        for now in np.arange(since + TICK, until, TICK):
            self.driver.tick(float(now))
            self.note(float(now))
        return self.driver.command

    def note(self, now: float) -> None:
        """Note a stop."""
        if self.driver.state == "stopped" and self.stopped_at is None:
            self.stopped_at = now
            self.drive.stops.append((now - self.start, self.driver.reason))

    def _lift(self, now: float) -> None:
        if self.stopped_at is None or self.lift_after is None:
            return
        if now - self.stopped_at >= self.lift_after:
            self.driver.lift(now)
            self.stopped_at = None


def drive_recording(
    driver: LiveDriver, recording: Recording, lift_after: float | None = None
) -> Drive:
    """Drive by the scans of a recording, at the times when they were logged, and return the drive.

    The car of the recording goes its own way, so its odometry is not compared with the commands.

    Args:
        lift_after: s after which a stop is lifted; None: never.
    """
    watched = _Watched(driver, lift_after, recording.log_time[0] / 1e9)
    before = None
    for scan, now in scans_of(recording):
        if before is not None:
            watched.ticks(before, now)
        watched.scan(scan, now)
        before = now
    watched.drive.ended = "the recording ended"
    return watched.drive


def scans_of(recording: Recording) -> Iterator[tuple[Scan, float]]:
    """Yield each scan of a recording, and the time when it was logged in s."""
    for index, points in enumerate(recording.points.tolist()):
        scan = Scan(
            recording.stamp[index] / 1e9,
            recording.ranges[index, :points],
            recording.angles(index)[:points],
            range_min=0.0,
            range_max=LARGEST,  # the reading has left out what is no return
        )
        yield scan, recording.log_time[index] / 1e9


def drive_simulation(
    driver: LiveDriver,
    env: SimulatedRobotEnv,
    seconds: float,
    *,
    lift_after: float | None = None,
    change: Callable[[int, Scan, float], tuple[Scan | None, float]] | None = None,
    follow: Callable[[int, Command], Command] | None = None,
    odometry: bool = True,
) -> Drive:
    """Drive the simulated robot until its episode ends, and return the drive.

    Its odometry, if it has any, is exact and comes with each scan.

    Args:
        env: of one robot, with the speed and size of the driver's car.
        seconds: of the drive at most.
        lift_after: s after which a stop is lifted; None: never.
        change: takes the number of a scan, the scan and the time of its end, and returns what
            reaches the driver and when, None for nothing: for faults.
        follow: takes the number of a scan and a command, and returns what the robot does.
        odometry: whether the driver is told how the robot moves.
    """
    watched, state = _Watched(driver, lift_after), env.reset()
    angles, period = env.lidar.angles.numpy(), 1 / env.rate
    command = driver.command
    for index in range(round(seconds * env.rate)):
        ranges, begin = env.scan[0].numpy().copy(), index * period
        scan: Scan | None
        scan, now = Scan(begin, ranges, angles, RANGE_MIN, RANGE_MAX), begin + period
        if change is not None:
            scan, now = change(index, scan, now)
        if scan is not None:
            command = watched.scan(scan, now)
        command = watched.ticks(now, begin + 2 * period)
        done = command if follow is None else follow(index, command)
        if done.speed > 0:
            action = np.arcsin(np.clip(done.turn_rate * env.car_length / driver.car.speed, -1, 1))
            state["action"] = env.action_spec.zero() + action / env.max_steering
            state = env.step_mdp(env.step(state))
            if bool(state["done"]):
                break
        else:
            env.stand()
        if odometry:
            command = driver.odometry(*done, begin + 2 * period)
            watched.note(begin + 2 * period)
    watched.drive.laps = int(env.lap)
    watched.drive.ended = _end_of(state)
    return watched.drive


def _end_of(state: object) -> str:
    """Return how the episode of the simulated robot ended, for a sentence."""
    info = state["info"]  # type: ignore[index]
    if bool(info["crashed"]):
        return "the robot crashed"
    if bool(info["completed"]):
        return "the robot completed its laps"
    return "the time was over"
