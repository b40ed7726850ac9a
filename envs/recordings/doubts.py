"""What makes the meaning of a recording doubtful: its clocks, gaps, scans, odometry and commands.

A recording whose scanner stood still, whose clock jumps or whose commands ended early is read
without an error, and gives numbers that mean little. Each of the functions here says so in the end
of a sentence that begins with the name of the file.
"""

import warnings

import numpy as np

from coil_rl.envs.recordings.recording import Recording, Times, ascending, believed

GAP = 2.5  # turns without a scan
MANY = 0.1  # share of the scans
CLOCKS_DIFFER = 2.0  # times as fast
FEWEST, CHECKED_SCANS = 12, 512  # scans that are compared, at most
PAIRED = 0.5  # of a pause between scans, and of what changes between them
DIFFERENT = 0.01  # m


def doubts_about(recording: Recording) -> list[str]:
    """Return remarks on what makes the meaning of a recording doubtful."""
    return [
        *_about_clock(recording),
        *_about_turns(recording),
        *_about_scans(recording),
        *_about_odometry(recording),
        *_about_commands(recording),
    ]


def _about_clock(recording: Recording) -> list[str]:
    """Return remarks on stamps that are no clock, and on log times that are none."""
    stamp, log_time = recording.stamp, recording.log_time
    if len(stamp) < 2:
        return ["has a single scan"]
    remarks = []
    if not ascending(stamp):
        remarks.append(f"has scans whose stamps {_fault(stamp)}, so their log times are the clock")
    elif not believed(stamp, log_time):
        remarks.append(
            f"has scans {1e9 / np.median(np.diff(stamp)):.3g} times a second by their stamps, so "
            "their log times are the clock"
        )
    elif ascending(log_time):
        ratio = float((stamp[-1] - stamp[0]) / (log_time[-1] - log_time[0]))
        if not 1 / CLOCKS_DIFFER < ratio < CLOCKS_DIFFER:
            remarks.append(
                f"has stamps that run {ratio:.3g} times as fast as its log times; the stamps are "
                "the clock"
            )
    late = (log_time - recording.arrival).max() / 1e9
    if late > recording.turn > 0:
        remarks.append(
            f"has scans that were logged up to {late:.2g} s late, so their stamps are the clock, "
            "and commands that were logged at once are spread over the scans between"
        )
    if not log_time.any() or log_time[0] == log_time[-1]:
        remarks.append("has log times that are all the same, so no command belongs to a scan")
    return remarks


def _about_turns(recording: Recording) -> list[str]:
    """Return a remark on gaps between the scans."""
    turn = recording.turn
    if len(recording.stamp) < 2:
        return []
    if turn == 0:
        return ["has no clock: most of its scans have the same time"]
    between = np.diff(recording.seconds)
    gaps = between[between > GAP * turn]
    if not len(gaps):
        return []
    number = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
    return [
        f"has {number} of more than {GAP:g} turns without a scan, the longest of {gaps.max():.1f} s"
    ]


def _fault(stamp: Times) -> str:
    """Return what is wrong with stamps that do not ascend."""
    if not stamp.any():
        return "are zero"
    step = np.diff(stamp)
    repeated, falling = int((step == 0).sum()), int((step < 0).sum())
    parts = [f"repeat {repeated} times"] if repeated else []
    parts += [f"fall {falling} times"] if falling else []
    return " and ".join(parts)


def _about_scans(recording: Recording) -> list[str]:
    """Return remarks on scans that are empty, repeated, or of two scanners."""
    ranges, remarks = recording.ranges, list[str]()
    scans = len(ranges)
    returns = np.isfinite(ranges)
    blind = int((~returns.any(axis=1)).sum())
    if blind > MANY * scans:
        remarks.append(f"has no return at all in {blind} of {scans} scans")
    same = (ranges[1:] == ranges[:-1]).all(axis=1) & returns[1:].any(axis=1)
    if same.sum() > MANY * scans:
        remarks.append(
            f"has {same.sum()} of {scans} scans that are equal to the one before, as if the "
            "scanner stood still or the driver repeated them"
        )
    if _alternate(recording):
        remarks.append(
            "has scans that are taken by turns from two places, or come in pairs, as those of two "
            "scanners: record each on a topic of its own"
        )
    return remarks


def _alternate(recording: Recording) -> bool:
    """Return whether scans are like the one before the last, not like the last, or are in pairs."""
    if len(recording.ranges) < FEWEST:
        return False
    between = np.diff(recording.seconds)
    pauses = np.median(between[::2]), np.median(between[1::2])
    if min(pauses) < PAIRED * max(pauses):
        return True
    some = np.where(np.isfinite(recording.ranges), recording.ranges, np.nan)[:CHECKED_SCANS]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of scans without a return
        last, before_last = (
            np.nanmedian(np.nanmedian(np.abs(some[step:] - some[:-step]), axis=1))
            for step in (1, 2)
        )
    return bool(last > DIFFERENT and before_last < PAIRED * last)


def _about_odometry(recording: Recording) -> list[str]:
    """Return a remark on scans at whose time there is no odometry."""
    if recording.odometry is None:
        return []
    outside = int((~recording.located).sum())
    if not outside:
        return []
    return [
        f"has no odometry at the time of {outside} of {len(recording.log_time)} scans, so their "
        "poses are those of its start or its end"
    ]


def _about_commands(recording: Recording) -> list[str]:
    """Return remarks on scans without a command, and on commands without a speed."""
    if recording.commands is None:
        return []
    commands, scans = recording.commands[0], len(recording.log_time)
    speed = recording.commands_of_scans(1.0)[:, 0]
    topic, number = recording.command_topic, len(commands)
    remarks = []
    missing = int(np.isnan(speed).sum())
    if missing:
        remarks.append(
            f"has no command of the last {recording.command_age:.2f} s at {missing} of {scans} "
            f"scans ({number} on {topic}), and no recorded steering there"
        )
    if not np.nan_to_num(commands).any():
        return [*remarks, f"has only zeros in its commands on {topic}"]
    if not np.nan_to_num(commands[:, 0]).any():
        source = "the nominal speed"
        if recording.odometry is not None:
            source = f"that of the odometry, {np.median(recording.motion()[0]):.3g} m/s,"
        remarks.append(f"has commands without a speed on {topic}, so {source} is taken")
    return remarks
