"""Level files: tracks as CSV in the format of the paper's authors, and the ten shipped tracks."""

import csv
import io
import math
import os
import re
import stat
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np

from coil_rl.envs.track import Track, TrackError

Split = Literal["train", "test", "all"]

MAX_BYTES = 10_000_000  # a hundred times the longest track
COLUMNS = ("Cone_Type", "Cone_X", "Cone_Y")


def load_track(path: str | os.PathLike[str], start: Sequence[float] | None = None) -> Track:
    """Read a level file: CSV with the columns Cone_Type (LEFT or RIGHT), Cone_X and Cone_Y (m, pointing down).

    Args:
        path: the file; extra columns, blank lines and case are ignored. A `TrackError` names it and
            its fault.
        start: x in m, y in m (pointing up), heading in degrees; see `Track` for the default.
    """
    path = Path(path)
    sides: dict[str, list[tuple[float, float]]] = {"LEFT": [], "RIGHT": []}
    for line, (side, *cells) in _rows(path):
        if side.upper() not in sides:
            raise TrackError(
                f"{path}, line {line}: Cone_Type is {side!r}; it must be LEFT or RIGHT."
            )
        try:
            x, y = np.asarray_chkfinite(cells, dtype=np.float64)
        except ValueError:
            fault = f"Cone_X, Cone_Y are {cells}; they must be finite numbers in m"
            raise TrackError(f"{path}, line {line}: {fault}.") from None
        sides[side.upper()].append((x, -y))
    left, right = (np.reshape(cones, (-1, 2)) for cones in sides.values())
    pose = None
    if start is not None:
        try:
            x, y, degrees = map(float, start)
        except (TypeError, ValueError):
            pattern = "three numbers: x and y (up) in m, heading in degrees"
            raise TrackError(f"{path}: the start is {start!r}; give {pattern}.") from None
        pose = x, y, math.radians(degrees)
    try:
        return Track(path.stem, left, right, pose)  # type: ignore[arg-type]
    except TrackError as error:
        raise TrackError(f"{path}: {error}") from None


def load_tracks(path: str | os.PathLike[str], start: Sequence[float] | None = None) -> list[Track]:
    """Read a level file, or all *.csv of a folder in natural order, with one `start` for all; see `load_track`."""
    if not os.path.isdir(path):
        return [load_track(path, start)]
    files = [
        file
        for file in Path(path).glob("*")
        if file.suffix.lower() == ".csv" and not file.name.startswith(".")
    ]
    if not files:
        raise TrackError(
            f"The folder {path} holds no level files (*.csv); give a folder with some, or one file."
        )
    # MAP_2 comes before MAP_10: every second part of the split is a number.
    files.sort(
        key=lambda file: [
            int(x) if i % 2 else x for i, x in enumerate(re.split(r"([0-9]+)", file.name))
        ]
    )
    return [load_track(file, start) for file in files]


def save_track(track: Track, path: str | os.PathLike[str]) -> None:
    """Write a level file for `load_track`; the format does not include the start pose."""
    cones = [("LEFT", *cone) for cone in track.left] + [("RIGHT", *cone) for cone in track.right]
    lines = [",".join(["", *COLUMNS])]
    # Adding zero turns -0.0 into 0.0.
    lines += [
        f"{k},{side},{round(x, 5) + 0.0},{round(-y, 5) + 0.0}"
        for k, (side, x, y) in enumerate(cones)
    ]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.unfinished")
    unfinished.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="")
    unfinished.replace(path)


def shipped_tracks(split: Split) -> list[Track]:
    """Return the project's own tracks: seven to "train" on, three to "test" on, or "all" ten."""
    if split not in ("train", "test", "all"):
        raise ValueError(
            f"There is no split {split!r} of the shipped tracks; give 'train', 'test' or 'all'."
        )
    return [
        track for part in ("train", "test") if split in (part, "all") for track in _shipped(part)
    ]


def track_names(tracks: Sequence[Track]) -> list[str]:
    """Return the names of tracks, which are the cases of an evaluation."""
    return [track.name for track in tracks]


def shipped_track(name: str) -> Track:
    """Return one of the project's own tracks by name, such as test_1."""
    tracks = {track.name: track for track in shipped_tracks("all")}
    if name not in tracks:
        raise ValueError(f"There is no shipped track {name!r}; there are {', '.join(tracks)}.")
    return tracks[name]


# Tracks are immutable, so they can be shared.
@cache
def _shipped(split: str) -> list[Track]:
    with resources.as_file(resources.files("coil_rl.envs") / "tracks" / split) as folder:
        return load_tracks(folder)


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the cells under `COLUMNS` of each row that is not blank; missing cells are empty."""
    try:
        status = path.stat()
        # Pipes and devices may never end.
        usable = stat.S_ISREG(status.st_mode) and status.st_size <= MAX_BYTES
        text = path.read_text(encoding="utf-8-sig") if usable else None
    except UnicodeDecodeError:
        raise TrackError(f"{path} is not a text file; save the level as CSV in UTF-8.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TrackError(
            f"{path} cannot be read ({reason}); give the path of a level file."
        ) from None
    if text is None:
        raise TrackError(
            f"{path} is no file of at most {MAX_BYTES} bytes; give the path of a level file."
        )
    if not text.strip():
        raise TrackError(
            f"{path} is empty; give a level file with the columns {', '.join(COLUMNS)}."
        )
    reader = csv.reader(io.StringIO(text))
    try:
        header = [name.strip() for name in next(reader)]
        columns = [name.casefold() for name in header]
        for column in COLUMNS:
            if column.casefold() not in columns:
                raise TrackError(
                    f"{path} has no column {column}; the columns of its first line are {header}."
                )
        order = [columns.index(column.casefold()) for column in COLUMNS]
        for row in reader:
            if any(cell.strip() for cell in row):
                yield reader.line_num, [row[i].strip() if i < len(row) else "" for i in order]
    except csv.Error as error:
        raise TrackError(
            f"{path}, line {reader.line_num}: {error}; save the level as plain CSV."
        ) from None
