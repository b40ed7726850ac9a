"""Odd recordings, made for tests: a drive of the simulated robot with one thing wrong in each.

Each kind comes from a report about a driver, a bag or a robot. `ODD` has by name a function that
changes the messages of a good drive, and words that must then be said of it; with `None` it
must give the same steering as for the good drive, or say something.
"""

import shutil
from dataclasses import dataclass, field

import numpy as np
from drives import rosbag_of

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

SECONDS = 8.0
STEP = 2 * np.pi / 360
FIRST = float(SimulatedLidar().angles[0])  # radians, of the first range
LAST = FIRST + 359 * STEP
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
        found = [("/scan", SCAN, *each) for each in self.scans]
        found += [("/odom", ODOMETRY, *each) for each in self.odometry]
        found += [(self.command_topic, self.command_type, *each) for each in self.commands]
        return found + self.more


def good_drive(folder, seconds=SECONDS, seed=4):
    """The path of a recorded drive of the spline guide on the simulated robot."""
    path = folder / "good.mcap"
    record_drives(SimulatedRobotEnv(time_limit=seconds, seed=seed), SplineGuide(), [path])
    return path


def messages_of(path):
    recording = read_recording(path)
    made = Messages()
    for row, ranges in enumerate(recording.ranges):
        fields = {
            "stamp_ns": START + int(recording.stamp[row]),
            "header": header(START + int(recording.stamp[row]), "laser"),
            "angle_min": FIRST,
            "angle_max": LAST,
            "angle_increment": STEP,
            "range_min": 0.15,
            "range_max": 12.0,
            "ranges": ranges.copy(),
        }
        made.scans.append((START + int(recording.log_time[row]), fields))
    for command, time in zip(*recording.commands, strict=True):
        made.commands.append((START + int(time), twist(*command.tolist())))
    poses, log_time, stamp = recording.odometry
    for (x, y, heading), time, stamped in zip(poses, log_time, stamp, strict=True):
        orientation = {"z": np.sin(heading / 2), "w": np.cos(heading / 2)}
        pose = {"pose": {"position": {"x": x, "y": y}, "orientation": orientation}}
        fields = {"header": header(START + int(stamped), "odom"), "pose": pose}
        made.odometry.append((START + int(time), fields))
    return made


def write(path, messages):
    with RecordingWriter(path) as writer:
        for topic, kind, time, fields in messages.all():
            kept = {key: value for key, value in fields.items() if key != "stamp_ns"}
            writer.add(topic, kind, time, kept)
    return path


def named(name, function):
    function.__name__ = name
    return function


def of_scans(name, **changes):
    """Set fields of all scans, each to a value or to a function of the old fields."""

    def change(drive):
        for _, fields in drive.scans:
            fields.update({k: v(fields) if callable(v) else v for k, v in changes.items()})

    return named(name, change)


def stamps(name, stamp_of):
    def change(drive):
        for number, (_, fields) in enumerate(drive.scans):
            fields["header"] = header(int(stamp_of(number, fields["stamp_ns"])), "laser")

    return named(name, change)


def commands(name, part, of, factor):
    def change(drive):
        for _, fields in drive.commands:
            fields[part][of] *= factor

    return named(name, change)


# Scans


mirrored = of_scans("mirrored", ranges=lambda scan: np.roll(scan["ranges"][::-1], -1))


def mirrored_by_turns(drive):
    for _, scan in drive.scans[::2]:
        scan["ranges"] = np.roll(scan["ranges"][::-1], -1)


backwards = of_scans("backwards", ranges=lambda scan: np.roll(scan["ranges"], 180))
turned_left = of_scans("turned_left", ranges=lambda scan: np.roll(scan["ranges"], 90))
step_of_one_more = of_scans("step_of_one_more", angle_increment=2 * np.pi / 361)
swapped_ends = of_scans("swapped_ends", angle_min=LAST, angle_max=FIRST)
clockwise = of_scans(
    "clockwise",
    angle_min=LAST,
    angle_max=FIRST,
    angle_increment=-STEP,
    ranges=lambda scan: scan["ranges"][::-1].copy(),
)
clockwise_with_a_positive_step = of_scans(
    "clockwise_with_a_positive_step", ranges=lambda scan: scan["ranges"][::-1].copy()
)
degrees = of_scans("degrees", angle_min=-179.0, angle_max=180.0, angle_increment=1.0)
step_in_degrees = of_scans("step_in_degrees", angle_increment=1.0)
no_step = of_scans("no_step", angle_increment=0.0)
no_angles = of_scans("no_angles", angle_min=0.0, angle_max=0.0, angle_increment=0.0)
no_last_angle = of_scans("no_last_angle", angle_max=0.0)
one_step_too_far = of_scans("one_step_too_far", angle_max=LAST + STEP)
many_turns = of_scans("many_turns", angle_increment=2.0, angle_max=FIRST + 2.0 * 359)
millimetres = of_scans("millimetres", ranges=lambda scan: scan["ranges"] * 1000)
all_millimetres = of_scans(
    "all_millimetres", ranges=lambda scan: scan["ranges"] * 1000, range_min=150.0, range_max=12e3
)
no_limits = of_scans("no_limits", range_min=0.0, range_max=0.0)
blind = of_scans("blind", ranges=np.full(360, np.inf, np.float32))


def room(drive):
    draw = np.random.default_rng(0)
    wall = 0.8 + 0.1 * np.sin(np.arange(360) / 20)
    for _, scan in drive.scans:
        scan["ranges"] = (wall + draw.normal(0, 0.002, 360)).astype(np.float32)


def frozen(drive):
    for _, scan in drive.scans[10:]:
        scan["ranges"] = drive.scans[9][1]["ranges"]


def one_scan(drive):
    drive.scans = drive.scans[:1]


# Clocks


zero_stamps = stamps("zero_stamps", lambda number, stamp: 0)
falling_stamps = stamps("falling_stamps", lambda number, stamp: 10**12 - stamp)
repeated_stamps = stamps("repeated_stamps", lambda number, stamp: stamp - stamp % 10**9)
stamps_a_thousand_times_too_fast = stamps(
    "stamps_a_thousand_times_too_fast", lambda number, stamp: stamp * 1000
)
stamps_a_million_times_too_slow = stamps(
    "stamps_a_million_times_too_slow", lambda number, stamp: number + 1
)
stamps_three_times_too_fast = stamps("stamps_three_times_too_fast", lambda number, stamp: stamp * 3)


def gaps(drive):
    del drive.scans[10:15], drive.scans[20:28]


def bursts(drive, period=400_000_000):
    for messages in (drive.scans, drive.commands, drive.odometry):
        messages[:] = [(-(-time // period) * period, fields) for time, fields in messages]


def bursts_of_scans(drive):
    kept = drive.commands, drive.odometry
    bursts(drive)
    drive.commands, drive.odometry = kept


def long_bursts_in_order(drive):
    bursts(drive, 10**9)
    drive.scans = [(time + n * 1000, fields) for n, (time, fields) in enumerate(drive.scans)]
    drive.commands = [(time + n * 1000, fields) for n, (time, fields) in enumerate(drive.commands)]


def bursts_of_stamped_commands(drive):
    stamped_commands(drive)
    bursts(drive)


def two_scanners_on_a_topic(drive):
    for time, fields in list(drive.scans):
        other = fields | {"ranges": np.roll(fields["ranges"], 60), "stamp_ns": 0}
        other["header"] = header(fields["stamp_ns"] + 91_000_000, "laser")
        drive.scans.append((time + 91_000_000, other))


def pairs_of_scans(drive):
    for time, fields in list(drive.scans):
        other = fields | {"header": header(fields["stamp_ns"] + 9_000_000, "laser")}
        drive.scans.append((time + 9_000_000, other))


def one_log_time(drive):
    for messages in (drive.scans, drive.commands, drive.odometry):
        messages[:] = [(10**9, fields) for _, fields in messages]


# Commands


def commands_end_early(drive):
    del drive.commands[12:]


def commands_before_the_drive(drive):
    drive.commands = [(time - 10**10, fields) for time, fields in drive.commands]


def commands_in_degrees(drive):
    for _, fields in drive.commands:
        fields["angular"]["z"] *= 180 / np.pi


commands_in_cm = commands("commands_in_cm", "linear", "x", 100)
commands_in_throttle = commands("commands_in_throttle", "linear", "x", 4)
commands_to_the_other_side = commands("commands_to_the_other_side", "angular", "z", -1)
commands_to_drive_backwards = commands("commands_to_drive_backwards", "linear", "x", -1)
commands_of_half_a_turn = commands("commands_of_half_a_turn", "angular", "z", 0.5)


def commands_a_second_late(drive):
    drive.commands = [(time + 10**9, fields) for time, fields in drive.commands]


def commands_two_seconds_early(drive):
    drive.commands = [(time - 10**9, fields) for time, fields in drive.commands]


def commands_of_another_drive(drive):
    times = [time for time, _ in drive.commands]
    fields = [fields for _, fields in drive.commands]
    drive.commands = list(zip(times, fields[20:] + fields[:20], strict=True))


def odometry_in_cm(drive):
    for _, fields in drive.odometry:
        for axis in "xy":
            fields["pose"]["pose"]["position"][axis] *= 100


def odometry_in_cm_and_commands_without_speed(drive):
    odometry_in_cm(drive)
    commands_without_speed(drive)


def odometry_of_the_other_side(drive):
    for _, fields in drive.odometry:
        fields["pose"]["pose"]["orientation"]["z"] *= -1


def commands_without_numbers(drive):
    for _, fields in drive.commands[:5]:
        fields["angular"]["z"] = np.nan


def commands_of_zeros(drive):
    drive.commands = [(time, twist(0.0, 0.0)) for time, _ in drive.commands]


def commands_without_speed(drive):
    for _, fields in drive.commands:
        fields["linear"]["x"] = 0.0


def stamped_commands(drive):
    drive.command_type = TWIST_STAMPED
    drive.commands = [
        (time, {"header": header(time, "base"), "twist": fields}) for time, fields in drive.commands
    ]


def _ackermann(drive, factor=1.0):
    made = []
    for time, fields in drive.commands:
        sine = np.clip(fields["angular"]["z"] * (2 / 7) / 0.15, -1, 1)
        made.append((time, {"speed": 0.15, "steering_angle": float(np.arcsin(sine)) * factor}))
    return made


def ackermann(drive):
    drive.command_type, drive.command_topic = ACKERMANN, "/drive"
    drive.commands = _ackermann(drive)


def ackermann_stamped(drive):
    drive.command_type, drive.command_topic = ACKERMANN_STAMPED, "/drive"
    drive.commands = [
        (time, {"header": header(time, "base"), "drive": fields})
        for time, fields in _ackermann(drive)
    ]


def ackermann_on_the_usual_topic(drive):
    drive.command_type = ACKERMANN
    drive.commands = _ackermann(drive)


def ackermann_in_degrees(drive):
    drive.command_type = ACKERMANN
    drive.commands = _ackermann(drive, 180 / np.pi)


def two_topics_of_commands(drive):
    drive.more = [("/joy_vel", TWIST, time, twist(0.0, 0.0)) for time, _ in drive.commands]


def two_other_topics_of_commands(drive):
    drive.command_topic = "/nav_vel"
    two_topics_of_commands(drive)


def two_types_of_commands(drive):
    drive.more = [
        ("/cmd_vel", ACKERMANN, time + 1, fields) for time, fields in _ackermann(drive)[::2]
    ]


def stamped_commands_by_turns(drive):
    drive.more = [
        ("/cmd_vel", TWIST_STAMPED, time, {"header": header(time, "base"), "twist": fields})
        for time, fields in drive.commands[1::2]
    ]
    del drive.commands[1::2]


def other_topic_of_odometry(drive):
    drive.more = [("/pf/odom", ODOMETRY, *each) for each in drive.odometry]
    drive.odometry = []


def short_odometry(drive):
    del drive.odometry[15:]


ODD = {
    mirrored: "the scans are mirrored",
    mirrored_by_turns: "the scans are mirrored",
    backwards: "180 for a laser that points backwards",
    turned_left: "both boundaries",
    step_of_one_more: "does not lead to angle_max",
    swapped_ends: "taken as exchanged",
    clockwise: None,
    clockwise_with_a_positive_step: "the scans are mirrored",
    degrees: "so its angles mean little",
    step_in_degrees: "does not lead to angle_max",
    no_step: "does not lead to angle_max",
    no_angles: "all its ranges have the same bearing",
    no_last_angle: "has no angle_max",
    one_step_too_far: "one step beyond the last range",
    many_turns: "over 114.3 turns",
    millimetres: "are they in mm?",
    all_millimetres: "are they in mm?",
    no_limits: "range_max=0",
    blind: "no return at all in 44 of 44 scans",
    room: "boundaries",
    frozen: "equal to the one before",
    one_scan: "a single scan",
    zero_stamps: "stamps are zero",
    falling_stamps: "stamps fall 43 times",
    repeated_stamps: "stamps repeat",
    stamps_a_thousand_times_too_fast: "0.0055 times a second by their stamps",
    stamps_a_million_times_too_slow: "times a second by their stamps",
    stamps_three_times_too_fast: "run 3 times as fast",
    gaps: "2 gaps of more than 2.5 turns without a scan, the longest of 1.6 s",
    bursts: "logged up to 0.36 s late",
    bursts_of_scans: "logged up to 0.36 s late",
    long_bursts_in_order: "logged up to 0.91 s late",
    bursts_of_stamped_commands: "logged up to 0.36 s late",
    two_scanners_on_a_topic: "as those of two scanners",
    pairs_of_scans: "as those of two scanners",
    one_log_time: "log times that are all the same",
    commands_end_early: "no command of the last 0.55 s at",
    commands_before_the_drive: "no command of the last 0.55 s at 44 of 44 scans (44 on /cmd_vel)",
    commands_in_degrees: "beyond what the robot can steer",
    commands_in_cm: "drives 0.01 times as fast as it is told (0.15 for 15 m/s)",
    commands_in_throttle: "drives 0.25 times as fast as it is told",
    commands_to_the_other_side: "against its commands",
    commands_to_drive_backwards: "drives -1 times as fast as it is told (-0.15 for 0.15 m/s)",
    commands_of_half_a_turn: "times as fast as it is told",
    commands_a_second_late: "before its commands",
    commands_two_seconds_early: "after its commands",
    commands_of_another_drive: "with the commands, by its odometry",
    odometry_in_cm: "drives 100 times as fast as it is told",
    odometry_in_cm_and_commands_without_speed: "that of the odometry, 15 m/s, is taken",
    odometry_of_the_other_side: "against its commands",
    commands_without_numbers: "5 of 44 commands",
    commands_of_zeros: "only zeros",
    commands_without_speed: "commands without a speed",
    stamped_commands: None,
    ackermann: "those on /drive are read instead",
    ackermann_stamped: "those on /drive are read instead",
    ackermann_on_the_usual_topic: None,
    ackermann_in_degrees: "beyond what the robot can steer",
    two_topics_of_commands: "commands on /cmd_vel, which are read, and on /joy_vel",
    two_other_topics_of_commands: "choose with command=/joy_vel or command=/nav_vel",
    two_types_of_commands: "several types on topic /cmd_vel",
    stamped_commands_by_turns: "where one of the 22 others was the last",
    other_topic_of_odometry: "choose with odometry=/pf/odom",
    short_odometry: "no odometry at the time of",
}

# Those of which a replay tells: the perception, the size of the robot, or the odometry.
OF_A_REPLAY = (
    mirrored,
    mirrored_by_turns,
    backwards,
    turned_left,
    clockwise_with_a_positive_step,
    room,
    commands_in_degrees,
    ackermann_in_degrees,
    commands_in_cm,
    commands_in_throttle,
    commands_to_the_other_side,
    commands_to_drive_backwards,
    commands_of_half_a_turn,
    commands_a_second_late,
    commands_two_seconds_early,
    commands_of_another_drive,
    odometry_in_cm,
    odometry_of_the_other_side,
)
IN_BURSTS = (
    bursts,
    bursts_of_scans,
    long_bursts_in_order,
    bursts_of_stamped_commands,
)


# Folders of rosbag2


def _folder(path, messages):
    made = []
    for topic, kind, time, fields in messages.all():
        made.append((topic, kind, time, {k: v for k, v in fields.items() if k != "stamp_ns"}))
    return rosbag_of(path, *sorted(made, key=lambda each: each[2]))


def _edit(folder, old, new):
    text = (folder / "metadata.yaml").read_text()
    assert old in text, text
    (folder / "metadata.yaml").write_text(text.replace(old, new))


def reindexed(folder):
    _edit(folder, "storage_identifier: mcap", "storage_identifier: ''")


def another_storage(folder):
    _edit(folder, "storage_identifier: mcap", "storage_identifier: sqlite3")


def wrong_count(folder):
    _edit(folder, "message_count: 44", "message_count: 440")


def file_not_listed(folder):
    shutil.copy(folder / "bag.mcap", folder / "bag_2.mcap")


def database_among_the_files(folder):
    (folder / "bag_1.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    _edit(folder, "- bag.mcap", "- bag.mcap\n  - bag_1.db3")


def listed_twice(folder):
    _edit(folder, "- bag.mcap", "- bag.mcap\n  - bag.mcap")


def file_missing(folder):
    _edit(folder, "- bag.mcap", "- bag.mcap\n  - bag_7.mcap")


ODD_FOLDERS = {
    reindexed: None,
    another_storage: None,
    wrong_count: "its metadata claim 440",
    file_not_listed: "bag_2.mcap, which its metadata do not list",
    database_among_the_files: "the SQLite storage of a ROS 2 bag",
    listed_twice: "more than once",
    file_missing: "lists bag_7.mcap, which is missing",
}


def make_odd_folder(folder, good, change):
    """Write an odd folder of rosbag2; return its path."""
    path = _folder(folder / change.__name__ / "bag", messages_of(good))
    change(path)
    return path
