"""What a replay has to learn, and what makes its meaning doubtful: the view and the commands.

A scan that is mirrored or turned, one of a room, and the commands of another drive give numbers
like any other ones. What is seen in all scans together, and the odometry, tell them apart.
"""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.recordings.recording import STANDS, Floats, Recording
from coil_rl.envs.robot.perception import Perception

if TYPE_CHECKING:
    from coil_rl.envs.recordings.replay_env import McapReplayEnv

CHECKED_SCANS = 512  # of a recording at most, evenly spread
MOST = 0.5  # share of the clusters, and of the scans
# Of the scans with both boundaries 0.97 and more with 30 % of the cones missing, see docs/robot.md.
IN_ORDER = 0.75  # of two views by turns, one of them mirrored, half
BEYOND = 0.1  # share of the commands
ROUNDING = 1.001  # of commands at the limit

# Of commands and odometry.
FEWEST = 12  # scans that are compared
ALIKE = 1.5  # times as fast
RELATED = 0.5  # correlation of the turn rates
LAGS = range(-8, 9)  # scans, by which the odometry is shifted
USUAL_LAGS = range(3)
VARIED = 0.02  # radians/s


def cautions_about(env: "McapReplayEnv", number: int) -> list[str]:
    """Return what makes the meaning of a recording doubtful in a replay, as sentences.

    Args:
        env: of the replay.
        number: of the recording.
    """
    recording = env.recordings[number]
    view = _about_view(env, number, recording)
    found = [f"{view}, so the actions mean little; check env.perception"] if view else []
    found += _about_commands(env, recording)
    return [f"{recording.path}: {each}" for each in found]


def _about_view(env: "McapReplayEnv", number: int, recording: Recording) -> str:
    """Return why a perception hardly fits a recording; empty if it does.

    It does not if few scans show both boundaries, if the left one is right of the right one, or if
    most clusters in sight are no cones.
    """
    scans = env.scans_of(number)
    both_valid, problems = env.valid[:, scans].all(0).cpu().numpy(), []
    if not both_valid.any():
        problems.append("no scan shows both boundaries")
    elif both_valid.mean() < MOST:
        problems.append(f"only {both_valid.mean():.0%} of the scans show both boundaries")
    known = env.known[scans]
    ordered = in_order(known["cones"].cpu().numpy(), known["cone_count"].cpu().numpy())
    if len(ordered) and ordered.mean() < IN_ORDER:
        problems.append(
            "the left cones lie left of the right ones (the scans are mirrored, as of a laser that "
            "is upside down; or turned, see perception.laser_yaw, 180 for a laser that points "
            "backwards; or thin cones stand on the right) in only "
            f"{ordered.mean():.0%} of the scans with both"
        )
    if isinstance(env.perception, Perception):
        some = slice(None, None, -(-len(recording.ranges) // CHECKED_SCANS))
        rejected = env.perception.rejected(recording.ranges[some], recording.angles(some))
        if rejected > MOST:
            problems.append(
                f"{rejected:.0%} of the clusters in sight are unlike any cone of the training "
                "(coil-reproduce figure=25 trains a classifier on your cones)"
            )
    return " and ".join(problems)


def in_order(cones: NDArray[np.floating], count: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether the left cones lie left, for each scan with cones of both sides.

    Compared are the means of the coordinate to the left.

    Args:
        cones: [N, 2, K, 2] m in the car's frame, left side first, padded.
        count: [N, 2], number of the cones.
    """
    real = np.arange(cones.shape[2]) < count[..., None]
    total = np.where(real, cones[..., 1], 0.0).sum(axis=2)
    both = (count > 0).all(axis=1)
    left, right = (total / np.maximum(count, 1))[both].T
    return np.asarray(left > right)


def _about_commands(env: "McapReplayEnv", recording: Recording) -> list[str]:
    """Return what makes the recorded commands doubtful: the robot's limit, and its odometry."""
    if recording.commands is None:
        return []
    angle, turn_rate, speed = recording.steering(env.speed, env.car_length)
    found, unit = [], "steering angles" if recording.steered else "turn rates"
    beyond = np.abs(angle) > env.max_steering * ROUNDING
    if not recording.steered:
        largest = np.abs(speed) * np.sin(env.max_steering) / env.car_length
        beyond = (speed != 0) & (np.abs(turn_rate) > largest * ROUNDING)
    known = ~np.isnan(angle)
    if known.any() and beyond[known].mean() > BEYOND:
        needed = "radians" if recording.steered else "radians a second, for env.car_length"
        found.append(
            f"{beyond[known].mean():.0%} of the recorded {unit} are beyond what the robot can "
            f"steer, and count as its limit; check that they are in {needed}"
        )
    if recording.odometry is not None:
        problems = _against_odometry(recording, speed, turn_rate)
        if problems:
            found.append(
                f"{' and '.join(problems)}, by its odometry; check units, signs and clocks of "
                "both, and that they are of one drive, or leave odometry out by env.odometry=null"
            )
    return found


def _against_odometry(recording: Recording, speed: Floats, turn_rate: Floats) -> list[str]:
    """Return in which ways the recorded commands contradict the odometry.

    Args:
        speed: m/s, [N], commanded.
        turn_rate: radians/s, [N], commanded.
    """
    moved, turned = recording.motion()
    known = (np.abs(speed) > STANDS) & ~np.isnan(turn_rate) & recording.located
    if known.sum() < FEWEST:
        return []
    problems = []
    driven = np.median((moved * np.sign(speed))[known])
    told = np.median(np.abs(speed[known]))
    if not 1 / ALIKE < driven / told < ALIKE:
        problems.append(
            f"the robot drives {driven / told:.3g} times as fast as it is told ({driven:.3g} for "
            f"{told:.3g} m/s)"
        )
    if max(turn_rate[known].std(), turned[known].std()) < VARIED:
        return problems
    related = {lag: _related(turn_rate, turned, known, lag) for lag in LAGS}
    lag, (correlation, factor) = max(related.items(), key=lambda each: abs(each[1][0]))
    if correlation < RELATED:
        against = ", against its commands" if correlation < -RELATED else ""
        problems.append(
            f"its turn rates have a correlation of {correlation:.2f} with the commands{against}"
        )
        return problems
    if lag not in USUAL_LAGS:
        when = "after" if lag > 0 else "before"
        problems.append(f"it turns {abs(lag) * recording.turn:.2f} s {when} its commands")
    if not 1 / ALIKE < factor < ALIKE:
        problems.append(f"it turns {factor:.3g} times as fast as it is told")
    return problems


def _related(
    commanded: Floats, measured: Floats, known: NDArray[np.bool_], lag: int
) -> tuple[float, float]:
    """Return the correlation of what is measured some scans later, and how many times it is.

    Args:
        known: [N], whether there is a command.
        lag: number of scans.
    """
    at = np.flatnonzero(known)
    at = at[(at + lag >= 0) & (at + lag < len(known))]
    if len(at) < FEWEST:
        return 0.0, 1.0
    one, other = commanded[at], measured[at + lag]
    one, other = one - one.mean(), other - other.mean()
    product, squares = float(one @ other), float(one @ one)
    size = np.sqrt(squares * float(other @ other))
    return (product / size, product / squares) if size > 0 else (0.0, 1.0)


def about_demonstrations(env: "McapReplayEnv") -> Iterator[str]:
    """Yield a line about each recording, and one about all together.

    It says how many scans are learned, how many are left out and why, and what makes the meaning of
    the recording doubtful.

    Raises:
        ValueError: if no scan has steering to learn.
    """
    kept, total = 0, 0
    _check_different(env.recordings)
    for row, recording in enumerate(env.recordings):
        scans = env.scans_of(row)
        stale, standing = env.known["stale"][scans], env.known["standing"][scans]
        number, usable = len(stale), int((~stale & ~standing).sum())
        kept, total = kept + usable, total + number
        line = (
            f"{recording.path}: {usable} of {number} scans are learned; left out: "
            f"{int(stale.sum())} without a command of the last {recording.command_age:.2f} s, "
            f"{int((standing & ~stale).sum())} of a robot that stands"
        )
        yield "; the file ".join([line, *recording.remarks])
        yield from (f"Warning: {text}." for text in env.cautions(row))
    yield f"{len(env.recordings)} recordings: {kept} of {total} scans are learned."
    if not kept:
        raise ValueError(
            "no scan has recorded steering to learn: there is no recent command at any, or the "
            "robot stands; give env.command=TOPIC, or other recordings"
        )


def _check_different(recordings: Sequence[Recording]) -> None:
    """Raise a `ValueError` for a recording that is there twice, which would test itself."""
    known: dict[bytes, Recording] = {}
    for recording in recordings:
        other = known.setdefault(recording.ranges.tobytes(), recording)
        if other is not recording:
            raise ValueError(
                f"{other.path} and {recording.path} hold the same scans; leave one of them out"
            )
