"""Recorded drives of a robot.

Existing recordings are reused. A drive is measured by its smoothness, its laps, its crash and its
line, and drawn.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.envs import Recording, RecordingError, Track, read_recording, record_drives
from coil_rl.envs.recordings import SIMULATED
from coil_rl.envs.robot import SPEED, THICK, THIN, RobotCourse, laps, middle_line, track_of
from coil_rl.report import style
from coil_robot import recorded_steering

Array = NDArray[np.float64]
Row = Mapping[str, Any]

MIDDLE_SPACING = 0.002  # m
MAX_POSES = 1000  # in one call, to limit the memory


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A recorded drive.

    Attributes:
        method: display name of the policy that drove.
        row: its measures without `smoothness`; `seed` is that of its run, None if there is no run.
        line: [M, 2] m, positions of the robot.
        track: the track; None if the recording has none.
    """

    method: str
    row: Row
    line: Array
    track: Track | None


def record(
    make_env_and_policy: Callable[[], tuple[EnvBase, TensorDictModuleBase]],
    paths: Sequence[Path],
    notes: Mapping[str, str],
    tick: Callable[[], Any] = lambda: None,
) -> list[Recording]:
    """Return recordings of a deterministic episode of each robot of an env.

    If all recordings exist, are complete and have the given notes, they are reused.

    Args:
        make_env_and_policy: makes the env of simulated robots, and the policy that drives them.
        paths: where to write the recordings, one for each robot.
        notes: what is noted in the recordings; it tells a policy and its robots from others.
        tick: called after each step.

    Raises:
        UserError: if the policy cannot drive the robots.
    """
    try:
        recordings = [read_recording(path, strict=True) for path in paths]
        noted = [recording.notes.get(SIMULATED, {}) for recording in recordings]
        if all(notes.items() <= of_recording.items() for of_recording in noted):
            return recordings
    except RecordingError:
        pass
    record_drives(*make_env_and_policy(), paths, notes, tick)
    return [read_recording(path) for path in paths]


def measure(recording: Recording, method: str | None = None) -> RecordedDrive:
    """Measure a recorded drive, except for its smoothness.

    Args:
        method: display name of the policy that drove; by default the `policy` in the recording's
            notes, or the file name.

    Raises:
        RecordingError: if the notes have an invalid track.
    """
    notes = recording.notes.get(SIMULATED, {})
    poses, seconds = _poses(recording)
    completed = laps(poses, seconds)
    row: dict[str, Any] = {
        "method": method or notes.get("policy", recording.path.stem),
        "seed": notes.get("seed"),
        "world": notes.get("world", ""),
        "recording": recording.path.name,
        "laps": len(completed.seconds),
        "lap_time": float(completed.seconds.mean()) if len(completed.seconds) else np.nan,
        "crashed": None,
        "off_centre": np.nan,
        "clearance": np.nan,
        "corner_cut": np.nan,
    }
    track = track_of(recording) if "track" in recording.notes else None
    if track is not None:
        row["clearance"] = _smallest_clearance(poses, track)
        row["crashed"] = row["clearance"] <= 0
        middle = cKDTree(middle_line(track, MIDDLE_SPACING))
        row["off_centre"] = float(middle.query(poses[:, :2])[0].mean())
        if len(completed.metres):
            row["corner_cut"] = float(completed.metres.mean()) / track.length
    return RecordedDrive(row["method"], row, poses[:, :2], track)


def _poses(recording: Recording) -> tuple[Array, Array]:
    """Return all poses of a drive, [M, 3] (m, m, radians), and their seconds since the start, [M].

    These are the poses of the odometry; without odometry, only those of the scans.
    """
    if recording.odometry is None:
        return recording.poses(), recording.seconds
    poses, log_time, stamp = recording.odometry
    clock = stamp if (np.diff(stamp) > 0).all() else log_time
    return poses, (clock - clock[0]) / 1e9


def _smallest_clearance(poses: Array, track: Track) -> float:
    """Return the smallest distance in m between the robot and a cone; poses are [M, 3]."""
    course = RobotCourse([track])
    index = torch.zeros(MAX_POSES, dtype=torch.int64)
    smallest = []
    for part in torch.from_numpy(poses).float().t().split(MAX_POSES, 1):
        clearance, *_ = course.clearance(index[: part.shape[1]], part)
        smallest.append(float(clearance.min()))
    return min(smallest)


def smoothness(recording: Recording, car_length: float, max_steering: float) -> float:
    """Return how much the steering changes: the mean of |a - weighted mean of the last 20 actions|.

    Args:
        recording: the drive; without commands its smoothness is NaN.
        car_length: length of the robot, m.
        max_steering: angle of an action of 1, degrees.
    """
    if recording.commands is None:
        return np.nan
    steering = recorded_steering(recording, SPEED, car_length, math.radians(max_steering))
    return float(np.nanmean(steering.smoothness))


def means(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the measures of several drives together.

    Lap time and corner cut are means weighted by the laps, the clearance is the smallest one, and
    the other measures are means over the drives.

    Args:
        rows: the measures of the drives, at least one.
    """
    crashes = [row["crashed"] for row in rows if row["crashed"] is not None]
    completed = [row for row in rows if row["laps"]]
    counts = [row["laps"] for row in completed]
    together: dict[str, Any] = {
        "drives": len(rows),
        "laps": sum(counts),
        "crashes": sum(crashes) if crashes else None,
        "clearance": min(row["clearance"] for row in rows),
    }
    for key in ("smoothness", "off_centre"):
        together[key] = float(np.mean([row[key] for row in rows]))
    for key in ("lap_time", "corner_cut"):
        values = [row[key] for row in completed]
        together[key] = float(np.average(values, weights=counts)) if counts else np.nan
    return together


def draw_drives(drives: Sequence[RecordedDrive], path: Path, title: str) -> None:
    """Draw the lines of each policy in a panel, with the cones of known tracks.

    Args:
        drives: the drives, at least one.
        title: above the picture.
    """
    panels: dict[tuple[str, str], list[RecordedDrive]] = {}
    for drive in drives:
        panels.setdefault((drive.row["world"], drive.method), []).append(drive)
    strokes = style.strokes(dict.fromkeys(method for _, method in panels))
    dots = {
        ("o", style.LEFT_CONE, "thin cones"): any(drive.track is not None for drive in drives),
        ("o", style.RIGHT_CONE, "thick cones"): any(drive.track is not None for drive in drives),
        ("X", style.INK, "crash"): any(drive.row["crashed"] for drive in drives),
    }
    handles = [_dot(*dot) for dot, is_shown in dots.items() if is_shown]
    rows = -(-len(panels) // 2)
    with style.picture(path, title, handles, 0.7 + 2.5 * rows) as figure:
        axes = list(figure.subplots(rows, 2, squeeze=False).flat)
        for panel, ((world, method), shown) in zip(axes, panels.items(), strict=False):
            count = f"{len(shown)} drives" if len(shown) > 1 else "one drive"
            name = f"{method}, {count} (m)"
            if world:
                name += f"\n{world}"
            _draw_panel(panel, shown, name, strokes[method].colour)
        for panel in axes[len(panels) :]:
            panel.axis("off")


def _draw_panel(axes: Axes, drives: Sequence[RecordedDrive], name: str, colour: str) -> None:
    axes.set_title(name, size=9, color=style.QUIET)
    axes.set_aspect("equal")
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0, labelsize=7)
    axes.grid(color=style.ASPHALT, lw=0.5)
    axes.set_axisbelow(True)
    tracks = {id(drive.track): drive.track for drive in drives if drive.track is not None}
    for track in tracks.values():
        _draw_cones(axes, track.left, THIN, style.LEFT_CONE)
        _draw_cones(axes, track.right, THICK, style.RIGHT_CONE)
    for drive in drives:
        axes.plot(*drive.line.T, color=colour, lw=0.8, alpha=0.6, zorder=4)
        if drive.row["crashed"]:
            axes.plot(
                *drive.line[-1], "X", ms=7, mfc=colour, mec=style.BACKGROUND, mew=0.8, zorder=5
            )


def _draw_cones(axes: Axes, cones: Array, radius: float, colour: str) -> None:
    """Draw cones, [N, 2] m, as discs with a radius in m."""
    discs = [Circle((x, y), radius) for x, y in cones.tolist()]
    axes.add_collection(PatchCollection(discs, fc=colour, ec=style.INK, lw=0.3, zorder=3))


def _dot(marker: str, colour: str, label: str) -> Line2D:
    return Line2D(
        [], [], ls="", marker=marker, ms=5, mfc=colour, mec=style.INK, mew=0.4, label=label
    )
