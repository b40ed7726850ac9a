"""Level files: tracks as CSV in the format of the paper's authors, and the ten shipped tracks."""

import csv
import io
import math
import os
import re
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coil_rl.envs.simulator_files import Row, is_of_simulator, numbers, simulator_track
from coil_rl.envs.track import Track, TrackError
from coil_rl.files import read_file, whole_file
from coil_rl.ranges import checked

Split = Literal["train", "test", "all"]

MAX_BYTES = 10_000_000  # a hundred times the longest track
COLUMNS = ("Cone_Type", "Cone_X", "Cone_Y")


def load_track(path: str | os.PathLike[str], start: Sequence[float] | None = None) -> Track:
    """Read a level file.

    It is a CSV with the columns Cone_Type (LEFT or RIGHT), Cone_X and Cone_Y (m, pointing down), or
    one of a Formula Student simulator, see `coil_rl.envs.simulator_files`.

    Args:
        path: the file; extra columns, blank lines and case are ignored.
        start: x in m, y in m (pointing up), heading in degrees; see `Track` for the default.

    Raises:
        TrackError: for a file that cannot be read or is no valid track; it names the file, the line
            and the fault.
    """
    path = Path(path)
    header, rows = _table(path)
    pose = _pose(path, start)
    try:
        if is_of_simulator(header):
            return simulator_track(path.stem, header[0].casefold(), rows, pose)
        left, right = _sides(header, rows)
        return Track(path.stem, left, right, pose)  # type: ignore[arg-type]
    except TrackError as error:
        raise TrackError(f"{path}: {str(error).rstrip('.')}.") from None


def _pose(path: Path, start: Sequence[float] | None) -> tuple[float, float, float] | None:
    """Return a start as m, m and radians; the path is for a message."""
    if start is None:
        return None
    try:
        x, y, degrees = map(float, start)
    except (TypeError, ValueError):
        raise TrackError(
            f"{path}: the start is {start!r}; give three numbers: x and y (up) in m, heading "
            "in degrees."
        ) from None
    return x, y, math.radians(degrees)


def _sides(header: Sequence[str], rows: Sequence[Row]) -> list[NDArray[np.float64]]:
    """Return the cones of both sides, [N, 2] m each, y pointing up."""
    for column in COLUMNS:
        if column.casefold() not in [name.casefold() for name in header]:
            raise TrackError(
                f"it has no column {column}; the columns of its first line are {header}"
            )
    sides: dict[str, list[tuple[float, float]]] = {"LEFT": [], "RIGHT": []}
    for line, row in rows:
        side = row.get("cone_type", "")
        if side.upper() not in sides:
            raise TrackError(f"line {line}: Cone_Type is {side!r}; it must be LEFT or RIGHT")
        x, y = numbers(row, COLUMNS[1:], line)
        sides[side.upper()].append((x, -y))
    return [np.reshape(cones, (-1, 2)) for cones in sides.values()]


def load_tracks(path: str | os.PathLike[str], start: Sequence[float] | None = None) -> list[Track]:
    """Read a level file, or all level files of a folder.

    Args:
        path: a level file, or a folder, whose *.csv are read in natural order.
        start: of all tracks: x in m, y in m (pointing up), heading in degrees; see `Track` for the
            default.

    Raises:
        TrackError: for a folder without level files, and as for `load_track`.
    """
    if not os.path.isdir(path):
        return [load_track(path, start)]
    visible = [file for file in Path(path).glob("*") if not file.name.startswith(".")]
    files = [file for file in visible if file.suffix.lower() == ".csv"]
    if not files:
        raise TrackError(
            f"The folder {path} holds no level files (*.csv); give a folder with some, or one file."
        )
    files.sort(key=_natural_order)
    return [load_track(file, start) for file in files]


def _natural_order(file: Path) -> list[str | int]:
    """Return a key that sorts MAP_2 before MAP_10: the name in parts, its numbers as numbers."""
    # Every second part of the split is a number.
    parts = enumerate(re.split(r"([0-9]+)", file.name))
    return [int(part) if index % 2 else part for index, part in parts]


def save_track(track: Track, path: str | os.PathLike[str]) -> None:
    """Write a level file for `load_track`; the format does not include the start pose.

    Args:
        track: the track.
        path: of the file; its folder is made if it is missing, and an existing file is replaced.
    """
    cones = [("LEFT", *cone) for cone in track.left] + [("RIGHT", *cone) for cone in track.right]
    lines = [",".join(["", *COLUMNS])]
    for number, (side, x, y) in enumerate(cones):
        # Adding zero turns -0.0 into 0.0.
        lines.append(f"{number},{side},{round(x, 5) + 0.0},{round(-y, 5) + 0.0}")
    with whole_file(path) as unfinished:
        unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="")


@checked
def shipped_tracks(split: Split) -> list[Track]:
    """Return the project's own tracks.

    Args:
        split: "train" for the seven to train on, "test" for the three to test on, or "all" ten;
            else a `ValueError`.
    """
    if split == "all":
        return [*_shipped("train"), *_shipped("test")]
    return list(_shipped(split))


def track_names(tracks: Sequence[Track]) -> list[str]:
    """Return the names of tracks, which are the cases of an evaluation.

    Args:
        tracks: the tracks.
    """
    return [track.name for track in tracks]


def shipped_track(name: str) -> Track:
    """Return one of the project's own tracks.

    Args:
        name: such as "test_1"; another than those of `shipped_tracks("all")` is a `ValueError`.
    """
    tracks = {track.name: track for track in shipped_tracks("all")}
    if name not in tracks:
        raise ValueError(f"There is no shipped track {name!r}; there are {', '.join(tracks)}.")
    return tracks[name]


# Tracks are immutable, so they can be shared.
@cache
def _shipped(split: str) -> list[Track]:
    with resources.as_file(resources.files("coil_rl.envs") / "tracks" / split) as folder:
        return load_tracks(folder)


def _table(path: Path) -> tuple[list[str], list[Row]]:
    """Return the header, and each row that is not blank."""
    reader = csv.reader(io.StringIO(_read(path)))
    try:
        header = [name.strip() for name in next(reader)]
        rows: list[Row] = []
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                named = zip(map(str.casefold, header), cells, strict=False)
                rows.append((reader.line_num, dict(named)))
    except csv.Error as error:
        raise TrackError(
            f"{path}, line {reader.line_num}: {error}; save the level as plain CSV."
        ) from None
    return header, rows


def _read(path: Path) -> str:
    """Return the text of a level file; a `TrackError` says why it cannot be read."""
    try:
        text = read_file(path, MAX_BYTES).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise TrackError(f"{path} is not a text file; save the level as CSV in UTF-8.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TrackError(
            f"{path} cannot be read ({reason}); give the path of a level file."
        ) from None
    if not text.strip():
        raise TrackError(
            f"{path} is empty; give a level file with the columns {', '.join(COLUMNS)}."
        )
    return text
