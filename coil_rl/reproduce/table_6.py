"""Tables 6 and 7 of the paper: how a robot drives, from its recordings alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tensordict.nn import TensorDictModule
from tqdm import tqdm

from coil_rl.envs.mcap_replay import McapReplayEnv
from coil_rl.envs.recordings import Recording, read_recording
from coil_rl.envs.robot_course import RobotCourse, middle_line
from coil_rl.envs.robot_laps import laps
from coil_rl.envs.simulated_recordings import record_drives, track_of
from coil_rl.envs.simulated_robot import SimulatedRobotEnv
from coil_rl.errors import UserError
from coil_rl.guides import SplineGuide
from coil_rl.report import markdown_table, write_csv
from coil_rl.reproduce.result import Result
from coil_rl.reproduce.table_6_picture import Drive, draw_drives

Array = NDArray[np.float64]

PAPER = {"guide": (0.265, 43.67), "oil": (0.104, 43.32), "ppo": (0.102, 40.14), "coil": (0.082, 39.53)}
REMARKS = {
    "guide": "sways, stays central",
    "oil": "smoother, less central",
    "ppo": "nearer the boundary",
    "coil": "cuts corners most",
}
MIDDLE_STEP = 0.002  # m
AT_ONCE = 1000  # poses

TABLE_6 = {
    "method": ("method", ""),
    "drives": ("drives", "d"),
    "laps": ("laps", "d"),
    "crashes": ("crashes", "d"),
    "smoothness": ("smoothness", ".3f"),
    "paper_smoothness": ("paper", ".3f"),
    "lap_time": ("lap (s)", ".2f"),
    "paper_lap_time": ("paper (s)", ".2f"),
}
TABLE_7 = {
    "method": ("method", ""),
    "off_centre": ("from the centre (m)", ".3f"),
    "clearance": ("smallest clearance (m)", ".3f"),
    "corner_cut": ("way / centre line", ".3f"),
    "remark": ("paper", ""),
}
NOTES = """
smoothness: mean of |a - weighted mean of the last 20 actions|, a the steering that the robot was told, as a fraction of
{max_steering:g} degrees. laps: from the start back to there, by odometry, and their mean time. crashes and what
follows need to know where the cones stood, which a recording notes as `track`: a robot crashed if its outline touched
a cone or its middle came to the line between two. The paper's robot drove on another track, so that its lap times
compare among themselves only. Each drive is a row of the CSV."""


class Table6(Result):
    """Smoothness, laps, crashes and lines of several drivers, each from one or several recordings.

    A recording goes by the `policy` that is noted in it, or else by its file's name. Without any recording the spline
    guide drives the simulated robot, and the table is of that alone.

    Args:
        recordings: MCAP files, rosbag2 directories or folders of MCAP files; or, by the name of the driver, lists of
            such.
        scan: topic of the LiDAR.
        odometry: topic of the odometry; without it the robot is taken to have obeyed its commands.
        command: topic of what the robot was told, such as what a replay says another policy would have.
        car_length: m, the robot's L.
        max_steering: degrees of an action of 1.

    Raises:
        UserError: if there is no recording where some should be.
        RecordingError: for one that cannot be used.
    """

    def __init__(
        self,
        recordings: Sequence[str] | Mapping[str, Sequence[str]] = (),
        *,
        scan: str = "/scan",
        odometry: str | None = "/odom",
        command: str | None = "/cmd_vel",
        car_length: float = 2 / 7,
        max_steering: float = 80.0,
    ) -> None:
        self.scan, self.odometry, self.command = scan, odometry, command
        self.car_length, self.max_steering = car_length, np.radians(max_steering)
        self._read(recordings)
        if recordings and not self.recordings:
            raise UserError(
                f"recordings={recordings} holds no MCAP file; give some, or let coil-robot drive and record"
            )

    def _read(self, recordings: Sequence[str] | Mapping[str, Sequence[str]]) -> None:
        named = recordings if isinstance(recordings, Mapping) else {"": recordings}
        self.recordings = [
            (name or recording.notes.get("simulated", {}).get("policy", path.stem), recording)
            for name, paths in named.items()
            for path in _files(paths)
            for recording in [read_recording(path, self.scan, self.odometry, self.command)]
        ]
        self.drives = [_drive(*of) for of in self.recordings]

    def make(self, stem: Path) -> str:
        """Make it: see `Result`."""
        if not self.recordings:
            paths = [stem.with_name("drives") / f"guide_{drive}.mcap" for drive in range(3)]
            with tqdm(desc="drive", unit="step", leave=False, mininterval=0.5) as bar:
                record_drives(SimulatedRobotEnv(num_cars=3), SplineGuide(), paths, {"policy": "guide"}, bar.update)
            self._read([str(path) for path in paths])
        smoothness = self._smoothness()
        rows = [{**drive.row, "smoothness": value} for drive, value in zip(self.drives, smoothness, strict=True)]
        by_method = {row["method"]: [other for other in rows if other["method"] == row["method"]] for row in rows}
        methods = [_mean(of_method) for of_method in by_method.values()]
        write_csv(rows, stem.with_suffix(".csv"))
        simulated = any("simulated" in recording.notes for _, recording in self.recordings)
        where = " (simulated)" if simulated else ""
        draw_drives(self.drives, stem.with_suffix(".png"), f"The driven lines{where}")
        return "\n\n".join(
            [
                f"## Table 6: the robot{where}",
                markdown_table(methods, TABLE_6),
                f"## Table 7, measured{where}",
                markdown_table(methods, TABLE_7),
                NOTES.format(max_steering=np.degrees(self.max_steering)).strip(),
            ]
        )

    def _smoothness(self) -> list[float]:
        """Of each recording, by the definition of the simulation: its commands are replayed."""
        told = [_actions(recording, self.car_length, self.max_steering) for _, recording in self.recordings]
        env = McapReplayEnv(
            [recording for _, recording in self.recordings], _sees_nothing,
            car_length=self.car_length, max_steering=float(np.degrees(self.max_steering)),
        )  # fmt: skip
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
            for row, actions, (_, recording) in zip(steps, told, self.recordings, strict=True)
        ]


def _files(paths: Sequence[str]) -> list[Path]:
    found: list[Path] = []
    for path in map(Path, paths):
        inside = path.is_dir() and not (path / "metadata.yaml").exists()
        found += sorted(path.glob("*.mcap")) if inside else [path]
    return found


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


def _drive(method: str, recording: Recording) -> Drive:
    """All about one recording but how smoothly it was steered."""
    poses, seconds = _places(recording)
    rounds = laps(poses, seconds)
    row: dict[str, Any] = {"method": method, "recording": recording.path.name, "laps": len(rounds.seconds)}
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


def _mean(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A method's row of both tables: means over its drives, of clearance the least, of lap times and ways over laps."""
    name = rows[0]["method"]
    smooth, lap = PAPER.get(name, (None, None))
    known = [row["crashed"] for row in rows if row["crashed"] is not None]
    around = [row for row in rows if row["laps"]]
    done = [row["laps"] for row in around]
    over_laps = {
        key: float(np.average([row[key] for row in around], weights=done)) if done else None
        for key in ("lap_time", "corner_cut")
    }
    return {
        "method": name, "drives": len(rows), "laps": sum(done), "crashes": sum(known) if known else None,
        "smoothness": float(np.mean([row["smoothness"] for row in rows])), "paper_smoothness": smooth,
        "paper_lap_time": lap, "off_centre": float(np.mean([row["off_centre"] for row in rows])),
        "clearance": min(row["clearance"] for row in rows), "remark": REMARKS.get(name), **over_laps,
    }  # fmt: skip
