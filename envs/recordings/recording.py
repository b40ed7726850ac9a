"""A robot recording as arrays: LiDAR scans, odometry and commands on one clock."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from coil_rl.envs.recordings.messages import ACKERMANN, ACKERMANN_STAMPED

SIMULATED = "simulated"  # metadata record of simulated recordings

# A command counts for three turns of the scanner, and for half a second at least: programs that
# drive send them faster, and robots stop without one.
LIVES = 3  # turns
LIVES_LONG = 0.5  # s
AT_ONCE = 0.1  # turns, between messages that came at once
STANDS = 0.01  # m/s, below which a robot does not drive
PLAUSIBLE_RATES = (1.0, 100.0)  # scans per second of a clock that is believed
# A message may be logged this much later than the quickest of so many beside it; what is later was
# not delayed, but one of the clocks is wrong.
LATE, BESIDE = 3.0, 61  # s, messages

Floats = NDArray[np.float64]
Times = NDArray[np.int64]


@dataclass(frozen=True)
class Recording:
    """N scans of a LiDAR, with the odometry and the commands of the drive.

    Args:
        path: of the file or folder.
        log_time: [N] ns, when the scans were recorded, ascending.
        stamp: [N] ns, start of each scan by the scanner's clock.
        ranges: [N, P] m; infinite if not finite or outside the scanner's range, and for padding.
        points: [N], number of ranges of each scan.
        angle_min: [N] radians, bearing of the first range.
        angle_increment: [N] radians, step of the bearing, negative for clockwise rotation.
        odometry: poses [M, 3] (m, m, radians), with their log times and stamps [M] ns; None without
            odometry.
        commands: [M, 2], with the times [M] ns when they came, see `arrivals`; None without
            commands. They are m/s and radians/s, or with Ackermann messages m/s and the steering
            angle in radians; NaN where a command was sent that is not known.
        frame: of the scanner.
        command_topic: topic of the commands; None without commands.
        command_type: message type of the commands.
        notes: metadata records by name.
        remarks: what the file has and the arrays lack, such as "is cut off: 160 scans can be read",
            and what makes their meaning doubtful.
    """

    path: Path
    log_time: Times
    stamp: Times
    ranges: NDArray[np.float32]
    points: NDArray[np.int64]
    angle_min: Floats
    angle_increment: Floats
    odometry: tuple[Floats, Times, Times] | None = None
    commands: tuple[Floats, Times] | None = None
    frame: str = "laser"
    command_topic: str | None = None
    command_type: str = ""
    notes: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    remarks: Sequence[str] = ()

    @property
    def simulated(self) -> bool:
        """Whether the metadata marks the recording as simulated."""
        return SIMULATED in self.notes

    @property
    def steered(self) -> bool:
        """Whether the commands have steering angles, not turn rates."""
        return self.command_type in (ACKERMANN, ACKERMANN_STAMPED)

    @property
    def seconds(self) -> Floats:
        """[N] s since the first scan.

        They are taken by the scanner's clock, or by log time if that clock is not ascending, or
        runs at a rate that no scanner has.
        """
        clock = self.stamp if believed(self.stamp, self.log_time) else self.log_time
        return (clock - clock[0]) / 1e9

    @property
    def arrival(self) -> Times:
        """[N] ns, when each scan came, by the clock of the log, see `arrivals`."""
        return arrivals(self.stamp, self.log_time)

    @property
    def turn(self) -> float:
        """Seconds of a turn of the scanner: the median time between scans, 0 for a single scan."""
        return float(np.median(np.diff(self.seconds))) if len(self.seconds) > 1 else 0.0

    @property
    def command_age(self) -> float:
        """Seconds for which a command counts."""
        return max(LIVES * self.turn, LIVES_LONG)

    def angles(self, scan: int | slice) -> Floats:
        """Return the bearings of a scan's ranges, [P] radians, or of several scans, [N, P]."""
        increment = self.angle_increment[scan][..., None]
        return np.asarray(
            self.angle_min[scan][..., None] + increment * np.arange(self.ranges.shape[1])
        )

    def poses(self, car_length: float = 2 / 7) -> Floats:
        """Return the pose at the start of each scan, [N, 3] m, m, radians.

        Interpolated from the odometry; without odometry integrated from the commands; zeros without
        either.

        Args:
            car_length: m, between the axles, for commands with steering angles.
        """
        if self.odometry is not None:
            pose, (scan_time, pose_time) = self.odometry[0], self._times_of_poses()
            # Relative times, as floating point would round absolute nanoseconds to a quarter of a
            # microsecond.
            at = (scan_time - pose_time[0]).astype(float)
            times = (pose_time - pose_time[0]).astype(float)
            columns = [pose[:, 0], pose[:, 1], np.unwrap(pose[:, 2])]
            return np.stack([np.interp(at, times, column) for column in columns], axis=1)
        if self.commands is not None:
            commands, times = self.commands
            if self.steered:
                speed, angle = commands.T
                commands = np.stack([speed, speed * np.sin(angle) / car_length], axis=1)
            return _integrate_commands(commands, times, self.arrival, self.command_age)
        return np.zeros((len(self.log_time), 3))

    @property
    def located(self) -> NDArray[np.bool_]:
        """[N], whether there is odometry at the time of a scan; false without any."""
        if self.odometry is None:
            return np.zeros(len(self.log_time), dtype=np.bool_)
        at, known = self._times_of_poses()
        limit = round(self.command_age * 1e9)
        return np.asarray((at >= known[0] - limit) & (at <= known[-1] + limit))

    def _times_of_poses(self) -> tuple[Times, Times]:
        """Return the times of scans and of poses by one clock, in ns."""
        _, log_time, stamp = self.odometry  # type: ignore[misc]
        stamped = ascending(self.stamp) and ascending(stamp)
        return (self.stamp, stamp) if stamped else (self.log_time, log_time)

    def commands_of_scans(self, nominal_speed: float) -> Floats:
        """Return the command of each scan, [N, 2], in the units of `commands`; NaN without one.

        It is the last command before those that come with the next scan: a controller needs time
        for a scan, and a program that sends commands at a higher rate repeats the old one
        meanwhile. One that is older than `command_age` counts no longer, and neither does one that
        comes so long after the scan. The speed is the command's own, with which its turn rate means
        a steering angle; if no command has one, that of the odometry, and without it the nominal
        one. A recording without commands is a `ValueError`.

        Args:
            nominal_speed: m/s.
        """
        if self.commands is None:
            raise ValueError(f"{self.path} has no commands; check that commands is not None")
        (commands, times), arrival = self.commands, self.arrival
        limit = round(self.command_age * 1e9)
        next_scan = np.append(arrival[1:], np.iinfo(np.int64).max)
        next_scan -= round(AT_ONCE * self.turn * 1e9)
        end = np.minimum(next_scan, arrival + limit + 1)
        last = np.searchsorted(times, end) - 1
        stale = (last < 0) | (arrival - times[last] > limit)
        rows = np.where(stale[:, None], np.nan, commands[last])
        if not np.nan_to_num(commands[:, 0]).any():
            speed = np.full(len(rows), nominal_speed) if self.odometry is None else self.motion()[0]
            rows[:, 0] = np.where(np.isnan(rows[:, 1]), np.nan, speed)
        return rows

    def steering(self, nominal_speed: float, car_length: float) -> tuple[Floats, Floats, Floats]:
        """Return the recorded steering at each scan (equations 99 and 100), NaN without a command.

        Where a turn rate is to be had without a speed, the steering is straight.

        Args:
            nominal_speed: m/s, for commands without speeds.
            car_length: m, between the axles.

        Returns:
            The steering angle in radians, the turn rate in radians/s and the speed in m/s, each
            [N].
        """
        speed, second = self.commands_of_scans(nominal_speed).T
        if self.steered:
            return second, speed * np.sin(second) / car_length, speed
        straight = np.where(np.isnan(second), np.nan, 0.0)
        sine = np.divide(second * car_length, speed, out=straight, where=speed != 0)
        return np.arcsin(sine.clip(-1, 1)), second, speed

    def motion(self) -> tuple[Floats, Floats]:
        """Return speed (m/s) and turn rate (radians/s) from each scan to the next one, [N] each.

        They are those of the poses. The speed is negative for a robot that drives backwards. After
        the last scan they are those before it.
        """
        if len(self.log_time) < 2:
            return np.zeros(1), np.zeros(1)
        x, y, heading = self.poses().T
        east, north, middle = np.diff(x), np.diff(y), (heading[1:] + heading[:-1]) / 2
        ahead = east * np.cos(middle) + north * np.sin(middle)
        way, time = np.copysign(np.hypot(east, north), ahead), np.diff(self.seconds)
        motion = np.stack([way, np.diff(heading)])
        rates = np.divide(motion, time, out=np.zeros_like(motion), where=time > 0)
        speed, turn_rate = np.append(rates, rates[:, -1:], axis=1)
        return speed, turn_rate


def ascending(times: Times) -> bool:
    """Return whether each time is later than the one before.

    Args:
        times: ns.
    """
    return bool((np.diff(times) > 0).all())


def believed(stamp: Times, log_time: Times) -> bool:
    """Return whether the stamps of scans are their clock, rather than their log times.

    Args:
        stamp: [N] ns.
        log_time: [N] ns, ascending.
    """
    if not ascending(stamp):
        return False
    if len(stamp) < 2 or _plausible(stamp):
        return True
    return not (ascending(log_time) and _plausible(log_time))


def arrivals(stamp: Times, log_time: Times) -> Times:
    """Return when messages came, in ns by the clock of the log.

    A recorder may write messages late and several at once. Where the sender's stamps are believed,
    they give order and age, as much later as the quickest message was logged; else log times do.
    """
    if not believed(stamp, log_time):
        return log_time
    delay = log_time - stamp
    offset = delay.min()
    # Not the smallest of all, as clocks drift apart.
    least = minimum_filter1d((delay - offset).astype(float), BESIDE)
    if (delay - offset - least).max() > LATE * 1e9:
        return log_time
    return stamp + offset + least.round().astype(np.int64)


def _plausible(times: Times) -> bool:
    """Return whether times could be those of the turns of a scanner."""
    low, high = PLAUSIBLE_RATES
    return bool(low <= 1e9 / np.median(np.diff(times)) <= high)


def _integrate_commands(commands: Floats, command_time: Times, time: Times, age: float) -> Floats:
    """Return the poses of a robot that holds each command until the next one.

    It stands before the first one, and where a command is too old.

    Args:
        commands: [M, 2] m/s and radians/s.
        command_time: [M] ns.
        time: [N] ns, times of the poses.
        age: s, for which a command counts.

    Returns:
        Poses [N, 3], m, m and radians.
    """
    end = command_time + round(age * 1e9)
    moments = np.unique(np.concatenate([command_time, end, time]))
    index = np.searchsorted(command_time, moments, side="right") - 1
    stands = (index < 0) | (moments >= end[index])
    speed, turn_rate = np.where(stands[:, None], 0.0, np.nan_to_num(commands[index])).T
    step = np.diff(moments, append=moments[-1:]) / 1e9
    heading = np.cumsum(turn_rate * step) - turn_rate * step
    # The chord of an arc has the direction of the arc's middle.
    direction = heading + turn_rate * step / 2
    chord = speed * step * np.sinc(turn_rate * step / (2 * np.pi))
    east, north = chord * np.cos(direction), chord * np.sin(direction)
    x, y = np.cumsum(east) - east, np.cumsum(north) - north
    return np.stack([x, y, heading], axis=1)[np.searchsorted(moments, time)]
