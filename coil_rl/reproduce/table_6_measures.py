"""What a robot's recordings tell of its drives: smoothness, laps, crashes, and how near to what it drove."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tensordict.nn import TensorDictModule

from coil_rl.envs.recordings.reading import SIMULATED, Recording
from coil_rl.envs.recordings.replay_env import McapReplayEnv
from coil_rl.envs.robot.course import RobotCourse, laps, middle_line
from coil_rl.envs.robot.drives import track_of
from coil_rl.envs.track import Track

Array = NDArray[np.float64]

MIDDLE_STEP = 0.002  # m
AT_ONCE = 1000  # poses


@dataclass(frozen=True, eq=False)
class Drive:
    """A recorded drive.

    Attributes:
        method: who drove.
        row: what was measured, but for `smoothness`; `seed` of its run, None if it is of none.
        line: [M, 2] m, where the robot was.
        track: on which, if that is known.
    """

    method: str
    row: Mapping[str, Any]
    line: Array
    track: Track | None


def measure(method: str, recording: Recording) -> Drive:
    """All about one recording but how smoothly the robot was steered.

    Raises:
        RecordingError: if it notes a track that is none.
    """
    poses, seconds = _places(recording)
    rounds = laps(poses, seconds)
    seed = recording.notes.get(SIMULATED, {}).get("seed")
    row: dict[str, Any] = {"method": method, "seed": seed, "recording": recording.path.name}
    row["laps"] = len(rounds.seconds)
    row["lap_time"] = float(rounds.seconds.mean()) if len(rounds.seconds) else float("nan")
    row |= {"crashed": None, "off_centre": float("nan"), "clearance": float("nan"), "corner_cut": float("nan")}
    track = track_of(recording) if "track" in recording.notes else None
    if track is not None:
        course, to_middle = RobotCourse([track]), cKDTree(middle_line(track, MIDDLE_STEP))
        at = torch.from_numpy(poses).float().t()
        first = torch.zeros(AT_ONCE, dtype=torch.int64)
        parts = [course.clearance(first[: part.shape[1]], part)[0] for part in at.split(AT_ONCE, 1)]
        row["clearance"] = float(torch.cat(parts).min())
        row["crashed"] = row["clearance"] <= 0
        row["off_centre"] = float(to_middle.query(poses[:, :2])[0].mean())
        if len(rounds.metres):
            row["corner_cut"] = float(rounds.metres.mean()) / track.length
    return Drive(method, row, poses[:, :2], track)


def smoothness(recordings: Sequence[Recording], car_length: float, max_steering: float) -> list[float]:
    """Of each recording, by the definition of the simulation: its commands are replayed; NaN without any.

    Args:
        recordings: at least one.
        car_length: m, the robot's L.
        max_steering: degrees of an action of 1.
    """
    told = [_actions(recording, car_length, np.radians(max_steering)) for recording in recordings]
    env = McapReplayEnv(list(recordings), _sees_nothing, car_length=car_length, max_steering=max_steering)
    longest = max(len(actions) for actions in told)
    table = torch.zeros(len(told), longest)
    for row, actions in zip(table, told, strict=True):
        row[: len(actions)] = torch.from_numpy(actions)

    def obey(scan: torch.Tensor) -> torch.Tensor:
        return table.gather(1, scan)

    policy = TensorDictModule(obey, in_keys=[("info", "scan")], out_keys=["action"])
    steps = env.rollout(longest, policy, break_when_any_done=False)["next", "info", "smoothness"].squeeze(-1)
    return [
        float(row[: len(actions)].double().mean()) if recording.commands is not None else float("nan")
        for row, actions, recording in zip(steps, told, recordings, strict=True)
    ]


def mean(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over drives, of clearance the least, of lap times and ways over laps; NaN where nothing is known."""
    known = [row["crashed"] for row in rows if row["crashed"] is not None]
    around = [row for row in rows if row["laps"]]
    done = [row["laps"] for row in around]
    over_laps = {
        key: float(np.average([row[key] for row in around], weights=done)) if done else float("nan")
        for key in ("lap_time", "corner_cut")
    }
    over_drives = {key: float(np.mean([row[key] for row in rows])) for key in ("smoothness", "off_centre")}
    return {
        "drives": len(rows), "laps": sum(done), "crashes": sum(known) if known else None,
        "clearance": min(row["clearance"] for row in rows), **over_drives, **over_laps,
    }  # fmt: skip


def _sees_nothing(ranges: NDArray[np.float32], angles: Array) -> tuple[Array, NDArray[np.int64]]:
    """What was told needs no cones."""
    return np.zeros((len(ranges), 2, 1, 2)), np.zeros((len(ranges), 2), dtype=np.int64)


def _actions(recording: Recording, car_length: float, max_steering: float) -> NDArray[np.float32]:
    """What a robot was told after each scan, [N] as fractions of `max_steering` (equations 99 and 100)."""
    scans = len(recording.log_time)
    if recording.commands is None:
        return np.zeros(scans, dtype=np.float32)
    commands, times = recording.commands
    # The last one before the next scan; until the first one it stands.
    until = np.append(recording.log_time[1:], np.iinfo(np.int64).max)
    last = np.searchsorted(times, until) - 1
    speed, turn_rate = np.where(last[:, None] < 0, 0.0, commands[last]).T
    sine = np.divide(turn_rate * car_length, speed, out=np.zeros(scans), where=speed != 0)
    actions = np.arcsin(sine.clip(-1, 1)) / max_steering
    return actions.clip(-1, 1).astype(np.float32)


def _places(recording: Recording) -> tuple[Array, Array]:
    """Where the robot was [M, 3], and when [M] s: all that the odometry says, or at each scan if there is none."""
    if recording.odometry is None:
        return recording.poses(), recording.seconds
    poses, log_time, stamp = recording.odometry
    clock = stamp if (np.diff(stamp) > 0).all() else log_time
    return poses, (clock - clock[0]) / 1e9
