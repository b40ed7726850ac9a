"""Odd recordings, made for tests: a drive of the simulated robot with one thing wrong in each.

Each kind comes from a report about a driver, a bag or a robot. The tables have changes of the
messages of a good drive, with the words that must then be said of it.
"""

import shutil
from dataclasses import dataclass, field

import numpy as np
from drives import odometry_fields, rosbag_of

from coil_rl.envs import SimulatedLidar, SimulatedRobotEnv, read_recording, record_drives
from coil_rl.envs.recordings.mcap_files import RecordingWriter
from coil_rl.envs.recordings.messages import (
    ACKERMANN,
    ACKERMANN_STAMPED,
    ODOMETRY,
    SCAN,
    TWIST,
    TWIST_STAMPED,
    header,
    twist,
)
from coil_rl.guides import SplineGuide

STEP = 2 * np.pi / 360
FIRST = float(SimulatedLidar().angles[0])  # radians, of the first range
START = 20 * 10**9  # ns, of the drive


@dataclass
class Messages:
    """Messages of a drive, each with its log time in ns, and the fields of its type."""

    scans: list = field(default_factory=list)
    odometry: list = field(default_factory=list)
    commands: list = field(default_factory=list)
    command_topic: str = "/cmd_vel"
    command_type: str = TWIST
    more: list = field(default_factory=list)  # topic, type, time, fields

    def all(self):
        """All messages by their log times, with their topics and types."""
        found = [("/scan", SCAN, *each) for each in self.scans]
        found += [("/odom", ODOMETRY, *each) for each in self.odometry]
        found += [(self.command_topic, self.command_type, *each) for each in self.commands]
        return sorted(found + self.more, key=lambda each: each[2])


def good_drive(folder):
    """The path of a recorded drive of the spline guide on the simulated robot, of 44 scans."""
    path = folder / "good.mcap"
    record_drives(SimulatedRobotEnv(time_limit=8.0, seed=4), SplineGuide(), [path])
    return path


def messages_of(path):
    recording = read_recording(path)
    made = Messages()
    for row, ranges in enumerate(recording.ranges):
        fields = {
            "header": header(START + int(recording.stamp[row]), "laser"),
            "angle_min": FIRST,
            "angle_max": FIRST + 359 * STEP,
            "angle_increment": STEP,
            "range_min": 0.15,
            "range_max": 12.0,
            "ranges": ranges.copy(),
        }
        made.scans.append((START + int(recording.log_time[row]), fields))
    for command, time in zip(*recording.commands, strict=True):
        made.commands.append((START + int(time), twist(*command.tolist())))
    poses, log_time, stamp = recording.odometry
    for pose, time, stamped in zip(poses, log_time, stamp, strict=True):
        made.odometry.append((START + int(time), odometry_fields(START + int(stamped), *pose)))
    return made


def write(path, messages):
    with RecordingWriter(path) as writer:
        for message in messages.all():
            writer.add(*message)
    return path


def changed(good, change, folder):
    """The path of a changed copy of a drive."""
    messages = messages_of(good)
    change(messages)
    return write(folder / "odd.mcap", messages)


# Scans


def scans(**changes):
    """Return a change of fields of all scans, each to a value or to a function of the old ones."""

    def change(drive):
        for _, scan in drive.scans:
            scan.update({k: v(scan) if callable(v) else v for k, v in changes.items()})

    return change


def in_millimetres(scan):
    return scan["ranges"] * 1000


def mirrored(scan):
    return np.roll(scan["ranges"][::-1], -1)


def backwards(scan):
    return np.roll(scan["ranges"], 180)


def mirrored_by_turns(drive):
    for _, scan in drive.scans[::2]:
        scan["ranges"] = mirrored(scan)


def frozen(drive):
    for _, scan in drive.scans[10:]:
        scan["ranges"] = drive.scans[9][1]["ranges"]


def one_scan(drive):
    del drive.scans[1:]


def gaps(drive):
    del drive.scans[10:15], drive.scans[20:28]


def two_scanners(pause, turn):
    """Return a change that adds a scan some ns after each one, turned by some ranges."""

    def change(drive):
        for time, scan in list(drive.scans):
            ranges = np.roll(scan["ranges"], turn)
            other = scan | {"header": header(stamp_of(scan) + pause, "laser"), "ranges": ranges}
            drive.scans.append((time + pause, other))

    return change


# Clocks


def stamp_of(scan):
    stamp = scan["header"]["stamp"]
    return stamp["sec"] * 10**9 + stamp["nanosec"]


def stamps(new):
    """Return a change of the stamps of all scans, a function of their numbers and old stamps."""

    def change(drive):
        for number, (_, scan) in enumerate(drive.scans):
            scan["header"] = header(int(new(number, stamp_of(scan))), "laser")

    return change


def logged(new, kinds=("scans", "commands", "odometry")):
    """Return a change of log times, a function of the numbers and the times of the messages."""

    def change(drive):
        for messages in (getattr(drive, kind) for kind in kinds):
            messages[:] = [(new(n, time), fields) for n, (time, fields) in enumerate(messages)]

    return change


def bursts(period=400_000_000, apart=0):
    """Return log times that are late, all of a period in ns at once or some ns apart."""
    return lambda number, time: -(-time // period) * period + apart * number


# Commands


def commands(part, axis, factor):
    """Return a change of a number of all commands."""

    def change(drive):
        for _, fields in drive.commands:
            fields[part][axis] *= factor

    return change


def later_commands(nanoseconds):
    return logged(lambda number, time: time + nanoseconds, ["commands"])


def commands_end_early(drive):
    del drive.commands[12:]


def commands_of_another_drive(drive):
    times = [time for time, _ in drive.commands]
    fields = [fields for _, fields in drive.commands]
    drive.commands = list(zip(times, fields[20:] + fields[:20], strict=True))


def commands_without_numbers(drive):
    for _, fields in drive.commands[:5]:
        fields["angular"]["z"] = np.nan


def commands_of_zeros(drive):
    drive.commands = [(time, twist(0.0, 0.0)) for time, _ in drive.commands]


def stamped(time, fields):
    return {"header": header(time, "base"), "twist": fields}


def stamped_commands(drive):
    drive.command_type = TWIST_STAMPED
    drive.commands = [(time, stamped(time, fields)) for time, fields in drive.commands]


def late_and_stamped(drive):
    stamped_commands(drive)
    logged(bursts())(drive)


def stamped_commands_by_turns(drive):
    every_other = [(time, stamped(time, fields)) for time, fields in drive.commands[1::2]]
    drive.more = [("/cmd_vel", TWIST_STAMPED, *each) for each in every_other]
    del drive.commands[1::2]


def ackermann(topic="/cmd_vel", unit=1.0, stamped=False):
    """Return a change of all commands to steering angles in a unit in radians."""

    def change(drive):
        drive.command_topic = topic
        drive.command_type = ACKERMANN_STAMPED if stamped else ACKERMANN
        for number, (time, fields) in enumerate(drive.commands):
            sine = np.clip(fields["angular"]["z"] * (2 / 7) / 0.15, -1, 1)
            angle = {"speed": 0.15, "steering_angle": float(np.arcsin(sine)) / unit}
            command = {"header": header(time, "base"), "drive": angle} if stamped else angle
            drive.commands[number] = time, command

    return change


def two_topics_of_commands(drive):
    drive.more = [("/joy_vel", TWIST, time, twist(0.0, 0.0)) for time, _ in drive.commands]


def two_other_topics_of_commands(drive):
    drive.command_topic = "/nav_vel"
    two_topics_of_commands(drive)


# Odometry


def odometry_in_cm_and_commands_without_speed(drive):
    for _, fields in drive.odometry:
        for axis in "xy":
            fields["pose"]["pose"]["position"][axis] *= 100
    for _, fields in drive.commands:
        fields["linear"]["x"] = 0.0


def other_topic_of_odometry(drive):
    drive.more = [("/pf/odom", ODOMETRY, *each) for each in drive.odometry]
    drive.odometry = []


def short_odometry(drive):
    del drive.odometry[15:]


# What is said when a recording is read.
OF_A_READING = [
    (scans(angle_max=FIRST + 360 * STEP), "one step beyond the last range"),
    (scans(angle_max=FIRST, angle_increment=0.0), "all its ranges have the same bearing"),
    (scans(ranges=in_millimetres), "range_max=12 m, and their median is"),
    (scans(ranges=in_millimetres, range_min=150.0, range_max=12e3), "are they in mm?"),
    (scans(range_min=0.0, range_max=0.0), "range_max=0"),
    (scans(ranges=np.full(360, np.inf, np.float32)), "no return at all in 44 of 44 scans"),
    (frozen, "equal to the one before"),
    (one_scan, "a single scan"),
    (gaps, "2 gaps of more than 2.5 turns without a scan, the longest of 1.6 s"),
    (two_scanners(91_000_000, turn=60), "as those of two scanners"),
    (two_scanners(9_000_000, turn=0), "as those of two scanners"),
    (stamps(lambda number, stamp: 0), "stamps are zero"),
    (stamps(lambda number, stamp: 10**12 - stamp), "stamps fall 43 times"),
    (stamps(lambda number, stamp: stamp - stamp % 10**9), "stamps repeat"),
    (stamps(lambda number, stamp: stamp * 1000), "0.0055 times a second by their stamps"),
    (stamps(lambda number, stamp: number + 1), "times a second by their stamps"),
    (stamps(lambda number, stamp: stamp * 3), "run 3 times as fast"),
    (logged(lambda number, time: 10**9), "log times that are all the same"),
    (later_commands(-(10**10)), "no command of the last 0.55 s at 44 of 44 scans (44 on /cmd_vel)"),
    (commands_without_numbers, "5 of 44 commands"),
    (commands_of_zeros, "only zeros"),
    (stamped_commands_by_turns, "where one of the 22 others was the last"),
    (two_topics_of_commands, "commands on /cmd_vel, which are read, and on /joy_vel"),
    (two_other_topics_of_commands, "choose with command=/joy_vel or command=/nav_vel"),
    (odometry_in_cm_and_commands_without_speed, "that of the odometry, 15 m/s, is taken"),
    (other_topic_of_odometry, "choose with odometry=/pf/odom"),
    (short_odometry, "no odometry at the time of"),
]
# Those that are logged late, so that commands must be spread over the scans.
IN_BURSTS = [
    (logged(bursts()), "logged up to 0.36 s late, so their stamps are the clock"),
    (logged(bursts(), ["scans"]), "logged up to 0.36 s late, so their stamps are the clock"),
    (late_and_stamped, "logged up to 0.36 s late, so their stamps are the clock"),
    (logged(bursts(10**9, apart=1000)), "logged up to 0.91 s late, so their stamps are the clock"),
]
# What is said of a replay: of its view, and of commands that contradict the odometry.
OF_A_REPLAY = [
    (scans(ranges=mirrored), "the scans are mirrored"),
    (mirrored_by_turns, "the scans are mirrored"),
    (scans(ranges=backwards), "180 for a laser that points backwards"),
    (commands("angular", "z", 180 / np.pi), "beyond what the robot can steer"),
    (ackermann(unit=np.pi / 180), "beyond what the robot can steer"),
    (commands("linear", "x", 100), "drives 0.01 times as fast as it is told (0.15 for 15 m/s)"),
    (commands("linear", "x", 0.25), "drives 4 times as fast as it is told"),
    (commands("linear", "x", -1), "drives -1 times as fast as it is told (-0.15 for 0.15 m/s)"),
    (commands("angular", "z", -1), "against its commands"),
    (commands("angular", "z", 0.5), "turns 1.81 times as fast as it is told"),
    (later_commands(10**9), "before its commands"),
    (later_commands(-(10**9)), "after its commands"),
    (commands_of_another_drive, "with the commands, by its odometry"),
]


# Folders of rosbag2


def changed_folder(good, change, folder):
    """The path of a copy of a good drive as a folder, whose files are changed."""
    path = rosbag_of(folder / "bag", *messages_of(good).all())
    change(path)
    return path


def metadata(old, new):
    """Return a change of the metadata of a folder."""

    def change(folder):
        text = (folder / "metadata.yaml").read_text()
        assert old in text, text
        (folder / "metadata.yaml").write_text(text.replace(old, new))

    return change


def file_not_listed(folder):
    shutil.copy(folder / "bag.mcap", folder / "bag_2.mcap")


def database_among_the_files(folder):
    (folder / "bag_1.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    metadata("- bag.mcap", "- bag.mcap\n  - bag_1.db3")(folder)


OF_A_FOLDER = [
    (metadata("storage_identifier: mcap", "storage_identifier: ''"), None),
    (metadata("storage_identifier: mcap", "storage_identifier: sqlite3"), None),
    (metadata("message_count: 44", "message_count: 440"), "its metadata claim 440"),
    (metadata("- bag.mcap", "- bag.mcap\n  - bag.mcap"), "more than once"),
    (metadata("- bag.mcap", "- bag.mcap\n  - bag_7.mcap"), "lists bag_7.mcap, which is missing"),
    (file_not_listed, "bag_2.mcap, which its metadata do not list"),
    (database_among_the_files, "the SQLite storage of a ROS 2 bag"),
]
