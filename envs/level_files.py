"""Level files: tracks as CSV, in the format of the paper's authors, and the ten tracks that come with the project."""

from __future__ import annotations

import csv
import io
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

LARGEST_FILE = 10_000_000  # bytes, a hundred times the longest track's
COLUMNS = ("Cone_Type", "Cone_X", "Cone_Y")


def load_track(path: str | os.PathLike[str], start: Sequence[float] | None = None) -> Track:
    """Read a level file: CSV with the columns Cone_Type (LEFT or RIGHT), Cone_X and Cone_Y (m, pointing down).

    Args:
        path: the file; further columns, blank lines and upper or lower case do not matter.
        start: x in m, y in m (pointing up), heading in degrees; without one, see `Track`.

    Raises:
        TrackError: in one sentence, what is wrong with the file.
    """
    path = Path(path)
    sides: dict[str, list[tuple[float, float]]] = {"LEFT": [], "RIGHT": []}
    for line, cells in _rows(path):
        kind = cells[0].upper()
        if kind not in sides:
            raise TrackError(f"{path}, line {line}: Cone_Type is {cells[0]!r}; it must be LEFT or RIGHT.")
        x, y = (_number(path, line, *cell) for cell in zip(COLUMNS[1:], cells[1:], strict=True))
        sides[kind].append((x, -y))
    left, right = (np.reshape(cones, (-1, 2)) for cones in sides.values())
    try:
        return Track(path.stem, left, right, None if start is None else _pose(start))  # type: ignore[arg-type]
    except TrackError as error:
        raise TrackError(f"{path}: {error}") from None


def load_tracks(path: str | os.PathLike[str], start: Sequence[float] | None = None) -> list[Track]:
    """Read one level file, or every *.csv of a folder, MAP_2 before MAP_10; `start` as in `load_track`, for all."""
    path = Path(path)
    try:
        if not path.is_dir():
            return [load_track(path, start)]
        files = [file for file in path.iterdir() if file.suffix.lower() == ".csv" and not file.name.startswith(".")]
    except OSError as error:
        raise TrackError(f"{path} cannot be read ({error.strerror}); give a level file or a folder of some.") from None
    if not files:
        raise TrackError(f"The folder {path} holds no level files (*.csv); give a folder with some, or one file.")
    # Every second part is a number.
    files.sort(key=lambda file: [int(x) if i % 2 else x for i, x in enumerate(re.split(r"([0-9]+)", file.name))])
    return [load_track(file, start) for file in files]


def save_track(track: Track, path: str | os.PathLike[str]) -> None:
    """Write a level file that `load_track` reads back; the format has no room for the start pose."""
    path = Path(path)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["", *COLUMNS])
    cones = [("LEFT", *cone) for cone in track.left] + [("RIGHT", *cone) for cone in track.right]
    for number, (side, x, y) in enumerate(cones):
        # Adding zero turns -0.0 into 0.0.
        writer.writerow([number, side, round(float(x), 5) + 0.0, round(-float(y), 5) + 0.0])
    path.parent.mkdir(parents=True, exist_ok=True)
    # A reader never meets half a level: the name appears once the file is whole.
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    unfinished.write_text(text.getvalue(), encoding="utf-8", newline="")
    unfinished.replace(path)


def shipped_tracks(split: Split) -> list[Track]:
    """The project's own tracks: seven to "train" on, three to "test" on, or "all" ten."""
    if split not in ("train", "test", "all"):
        raise ValueError(f"There is no split {split!r} of the shipped tracks; give 'train', 'test' or 'all'.")
    return list(_shipped(split))


def shipped_track(name: str) -> Track:
    """The one of the project's own tracks that is called so, such as test_1."""
    tracks = {track.name: track for track in shipped_tracks("all")}
    if name not in tracks:
        raise ValueError(f"There is no shipped track {name!r}; there are {', '.join(tracks)}.")
    return tracks[name]


# Tracks cannot be changed, so everybody may have the same ones.
@cache
def _shipped(split: Split) -> tuple[Track, ...]:
    tracks: list[Track] = []
    for part in ("train", "test") if split == "all" else (split,):
        with resources.as_file(resources.files("coil_rl.envs") / "tracks" / part) as folder:
            tracks += load_tracks(folder)
    return tuple(tracks)


def _read_text(path: Path) -> str:
    try:
        about = path.stat()
        # A pipe would wait for ever, a device never end.
        if stat.S_ISCHR(about.st_mode) or stat.S_ISFIFO(about.st_mode) or about.st_size > LARGEST_FILE:
            raise TrackError(f"{path} is no file of at most {LARGEST_FILE} bytes; give the path of a level file.")
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise TrackError(f"{path} cannot be read ({error.strerror}); give the path of a level file.") from None
    except UnicodeDecodeError:
        raise TrackError(f"{path} is not a text file; save the level as CSV in UTF-8.") from None
    except ValueError as error:
        if isinstance(error, TrackError):
            raise
        raise TrackError(f"{str(path)!r} is no path ({error}); give the path of a level file.") from None
    if not text.strip():
        raise TrackError(f"{path} is empty; give a level file with the columns {', '.join(COLUMNS)}.")
    return text


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Of each row that is not blank, its line number and its cells under `COLUMNS`, an empty text for a missing one."""
    reader = csv.reader(io.StringIO(_read_text(path), newline=""))
    try:
        header = [name.strip() for name in next(reader)]
        known = [name.casefold() for name in header]
        for column in COLUMNS:
            if column.casefold() not in known:
                found = ", ".join(filter(None, header)) or "none"
                raise TrackError(f"{path} has no column {column}; its first line names these: {found}.")
        order = [known.index(column.casefold()) for column in COLUMNS]
        for row in reader:
            if any(cell.strip() for cell in row):
                yield reader.line_num, [row[i].strip() if i < len(row) else "" for i in order]
    except csv.Error as error:
        raise TrackError(f"{path}, line {reader.line_num}: {error}; save the level as plain CSV.") from None


def _number(path: Path, line: int, column: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise TrackError(f"{path}, line {line}: {column} is {cell!r}; it must be a finite number in m.")
    return number


def _pose(start: Sequence[float]) -> tuple[float, float, float]:
    try:
        x, y, degrees = (float(value) for value in start)
    except (TypeError, ValueError):
        raise TrackError(
            f"the start is {start!r}; give three numbers: x and y (up) in m, heading in degrees."
        ) from None
    return x, y, float(np.deg2rad(degrees))
