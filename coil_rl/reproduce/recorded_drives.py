"""Recorded drives of a robot: the reuse of existing recordings, and measures of smoothness, laps, crashes and lines."""

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
from scipy.spatial import cKDTree
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from coil_rl.envs.recordings.reading import SIMULATED, Recording, RecordingError, read_recording
from coil_rl.envs.robot.course import THICK, THIN, RobotCourse, laps, middle_line
from coil_rl.envs.robot.drives import SPEED, record_drives, track_of
from coil_rl.envs.track import Array, Track
from coil_rl.replay.open_loop import recorded_steering
from coil_rl.report import style

Row = Mapping[str, Any]

MIDDLE_SPACING = 0.002  # m
MAX_POSES = 1000  # in one call, to limit the memory


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A recorded drive."""

    method: str  # display name of the driver
    row: (
        Row  # its measures without `smoothness`; `seed` is that of its run, None if there is no run
    )
    line: Array  # [M, 2] m, positions of the robot
    track: Track | None  # None if the recording has none


def record(
    make_env_and_policy: Callable[[], tuple[EnvBase, TensorDictModuleBase]],
    paths: Sequence[Path],
    notes: Mapping[str, str],
    tick: Callable[[], Any] | None = None,
) -> list[Recording]:
    """Return recordings of a deterministic episode of each robot of an env; complete ones with equal notes are reused.

    The arguments are those of `record_drives`. The notes tell a driver and its robots from others.
    A policy that cannot drive the robots is a `UserError`.
    """
    try:
        recordings = [read_recording(path, strict=True) for path in paths]
        if all(
            notes.items() <= recording.notes.get(SIMULATED, {}).items() for recording in recordings
        ):
            return recordings
    except RecordingError:
        pass
    record_drives(*make_env_and_policy(), paths, notes, tick)
    return [read_recording(path) for path in paths]


def measure(recording: Recording, method: str | None = None) -> RecordedDrive:
    """Measure a recorded drive, except for its smoothness.

    `method` is the driver's display name; by default the `policy` in the recording's notes, or the
    file name. An invalid track in the notes is a `RecordingError`.
    """
    notes = recording.notes.get(SIMULATED, {})
    if recording.odometry is None:
        poses, seconds = recording.poses(), recording.seconds
    else:  # all of its poses, not only those of the scans
        poses, log_time, stamp = recording.odometry
        clock = stamp if (np.diff(stamp) > 0).all() else log_time
        seconds = (clock - clock[0]) / 1e9
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
        course, middle = RobotCourse([track]), cKDTree(middle_line(track, MIDDLE_SPACING))
        parts = torch.from_numpy(poses).float().t().split(MAX_POSES, 1)
        index = torch.zeros(MAX_POSES, dtype=torch.int64)
        row["clearance"] = min(
            float(course.clearance(index[: part.shape[1]], part)[0].min()) for part in parts
        )
        row["crashed"] = row["clearance"] <= 0
        row["off_centre"] = float(middle.query(poses[:, :2])[0].mean())
        if len(completed.metres):
            row["corner_cut"] = float(completed.metres.mean()) / track.length
    return RecordedDrive(row["method"], row, poses[:, :2], track)


def smoothness(recording: Recording, car_length: float, max_steering: float) -> float:
    """Return the mean of |a - weighted mean of the last 20 actions|; NaN for a recording without commands.

    The robot has the length `car_length` in m; `max_steering` is the angle of an action of 1 in
    degrees.
    """
    if recording.commands is None:
        return np.nan
    steering = recorded_steering(recording, SPEED, car_length, math.radians(max_steering))
    return float(np.nanmean(steering.smoothness))


def means(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the means over drives: the minimum of the clearance, lap time and corner cut weighted by laps."""
    crashes = [row["crashed"] for row in rows if row["crashed"] is not None]
    completed = [row for row in rows if row["laps"]]
    counts = [row["laps"] for row in completed]
    values = {
        key: float(np.mean([row[key] for row in rows])) for key in ("smoothness", "off_centre")
    }
    for key in ("lap_time", "corner_cut"):
        values[key] = (
            float(np.average([row[key] for row in completed], weights=counts)) if counts else np.nan
        )
    clearance, crashed = min(row["clearance"] for row in rows), sum(crashes) if crashes else None
    return {
        "drives": len(rows),
        "laps": sum(counts),
        "crashes": crashed,
        "clearance": clearance,
        **values,
    }


def draw_drives(drives: Sequence[RecordedDrive], path: Path, title: str) -> None:
    """Draw the lines of each driver in a panel, with the cones of known tracks."""
    names = [(drive.row["world"], drive.method) for drive in drives]
    panels = {
        name: [drive for drive, of in zip(drives, names, strict=True) if of == name]
        for name in names
    }
    strokes = style.strokes(dict.fromkeys(method for _, method in panels))
    handles: list[Line2D] = []
    if any(drive.track is not None for drive in drives):
        handles += [
            _dot("o", style.LEFT_CONE, "thin cones"),
            _dot("o", style.RIGHT_CONE, "thick cones"),
        ]
    if any(drive.row["crashed"] for drive in drives):
        handles.append(_dot("X", style.INK, "crash"))
    rows = -(-len(panels) // 2)
    with style.picture(path, title, handles, 0.7 + 2.5 * rows) as figure:
        axes = list(figure.subplots(rows, 2, squeeze=False).flat)
        for panel, ((world, method), shown) in zip(axes, panels.items(), strict=False):
            count = f"{len(shown)} drives" if len(shown) > 1 else "one drive"
            name = "\n".join([f"{method}, {count} (m)", *filter(None, [world])])
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
    for track in {
        id(drive.track): drive.track for drive in drives if drive.track is not None
    }.values():
        for cones, radius, fill in (
            (track.left, THIN, style.LEFT_CONE),
            (track.right, THICK, style.RIGHT_CONE),
        ):
            discs = [Circle((x, y), radius) for x, y in cones.tolist()]
            axes.add_collection(PatchCollection(discs, fc=fill, ec=style.INK, lw=0.3, zorder=3))
    for drive in drives:
        axes.plot(*drive.line.T, color=colour, lw=0.8, alpha=0.6, zorder=4)
        if drive.row["crashed"]:
            axes.plot(
                *drive.line[-1], "X", ms=7, mfc=colour, mec=style.BACKGROUND, mew=0.8, zorder=5
            )


def _dot(marker: str, colour: str, label: str) -> Line2D:
    return Line2D(
        [], [], ls="", marker=marker, ms=5, mfc=colour, mec=style.INK, mew=0.4, label=label
    )
