"""Where the states of a survey are: in a section of a track, or at a step of the episode.

The sections of a track are straights, left and right turns, their entries and their exits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from coil_rl.cones import draw_listening_map
from coil_rl.envs.track import AS_COMPLEX, Array, Track, resample
from coil_rl.ranges import Interval, checked
from coil_rl.report import style, write_csv
from coil_studies.listening.measures import drawn

if TYPE_CHECKING:
    from coil_studies.listening.survey import Survey

Length = Annotated[float, Interval(ge=0.1, le=100)]  # m
SECTIONS = ("straight", "left", "right", "entry", "exit")
STRAIGHT, LEFT, RIGHT, ENTRY, EXIT = range(len(SECTIONS))
SMOOTHING = 1.0  # m
POINTS = 100  # of a curve, at most


def smooth_line(track: Track, spacing: float = 0.25, smoothing: float = SMOOTHING) -> Array:
    """Return the line half-way between the boundaries, smoothed over single cones.

    Args:
        spacing: approximate distance between points, m.
        smoothing: standard deviation s of the Gaussian filter, m; a turn of radius R becomes
            s^2 / 2R smaller.

    Returns:
        [P, 2] m, closed, from the start.
    """
    middle = resample(track.middle(), spacing)
    return np.asarray(gaussian_filter1d(middle, smoothing / spacing, axis=0, mode="wrap"))


def curvature(line: Array) -> Array:
    """Return the curvature [P] in 1/m of a closed line [P, 2], positive in left turns.

    Args:
        line: [P, 2] m.
    """
    edge = (np.roll(line, -1, axis=0) - line) @ AS_COMPLEX
    turn = np.angle(edge * np.roll(edge, 1).conj())
    return np.asarray(2 * turn / (np.abs(edge) + np.abs(np.roll(edge, 1))))


def classify(line: Array, turn_radius: float = 10.0, approach: float = 4.0) -> NDArray[np.int64]:
    """Return the section of each point of a closed line.

    Between two turns that are close the exit of the first one ends half-way.

    Args:
        line: [P, 2] m.
        turn_radius: a turn is curved more than a circle of this radius, m.
        approach: length of an entry, before a turn, and of an exit, after it, m.

    Returns:
        [P], indices in SECTIONS.
    """
    bend = curvature(line)
    turning = np.flatnonzero(np.abs(bend) * turn_radius > 1)
    section = np.full(len(line), STRAIGHT)
    if len(turning):
        index, count = np.arange(len(line)), len(line)
        step = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1).mean()
        # The line is closed: the first turning point is also the next one of the last turn.
        following = np.append(turning, turning[0] + count)
        to_next = following[np.searchsorted(turning, index)] - index
        preceding = np.append(turning[-1] - count, turning)
        since_last = index - preceding[np.searchsorted(turning, index, side="right")]
        section[(since_last < to_next) & (since_last * step <= approach)] = EXIT
        section[(to_next <= since_last) & (to_next * step <= approach)] = ENTRY
        section[turning] = np.where(bend[turning] > 0, LEFT, RIGHT)
    return section


class WholeEpisode:
    """The whole episode as one section, drawn by step.

    It is the base class of the divisions of an episode into sections.

    Attributes:
        names: of the sections; empty for no division.
        record: entries of every step that `draw` needs, by name.
    """

    names: ClassVar[tuple[str, ...]] = ()
    record: ClassVar[Mapping[str, NestedKey]] = {}

    def locate(self, state: TensorDictBase) -> dict[str, Tensor]:
        """Return where each row is, besides the number of the step.

        Args:
            state: [B], of the env.

        Returns:
            Entries [B, ...] by name.
        """
        return {}

    def section(self, place: TensorDictBase) -> Tensor:
        """Return the index of the section of each place, [B].

        Args:
            place: [B], entries as `locate` returns them.
        """
        return torch.zeros(place.batch_size, dtype=torch.int64, device=place.device)

    def draw(self, data: Survey, folder: Path) -> None:
        """Draw the mean of each measure against the step.

        Args:
            folder: of the pictures and of the numbers, `listening.csv`, which is the last file.
        """
        size = max(1, -(-int(data.step.max() + 1) // POINTS))
        rows = data.means(**{"from": data.step // size * size})
        strokes = style.strong_strokes(data.guides)
        handles = style.handles(strokes)
        for measure, title, label, name in drawn(data.measures):
            with style.picture(folder / name, title, handles, 3.6) as figure:
                axes = figure.add_subplot(xlabel="step of the episode", ylabel=label)
                style.lighten(axes)
                for guide, stroke in strokes.items():
                    own = [row for row in rows if row["guide"] == guide]
                    x, y = [row["from"] for row in own], [row[measure] for row in own]
                    axes.plot(x, y, color=stroke.colour, ls=stroke.linestyle, lw=1.5)
        write_csv(rows, folder / "listening.csv")


@checked
@dataclass(eq=False)
class TrackSections(WholeEpisode):
    """Lookup of the section of a track in which a car is, by the nearest point of the middle line.

    The env writes `info` with the index of the `track` and the `pose` of each car, as
    `ConeTrackEnv` does.

    Args:
        tracks: of the env, in its order.
        turn_radius: a turn is curved more than a circle of this radius, m.
        approach: length of the entry and of the exit of a turn, m.
        bin: length of track per value of the maps, m; it is rounded so that their
            number on a track is whole.
    """

    names: ClassVar[tuple[str, ...]] = SECTIONS
    record: ClassVar[Mapping[str, NestedKey]] = {"pose": ("info", "pose")}
    tracks: Sequence[Track]
    _: KW_ONLY
    turn_radius: Annotated[float, Interval(ge=0.5, le=1000)] = 10.0
    approach: Length = 4.0
    bin: Length = 1.0

    def __post_init__(self) -> None:
        self.lines = [smooth_line(track) for track in self.tracks]  # [P, 2] m each
        # Indices in SECTIONS, [P] each.
        self.sections = [classify(line, self.turn_radius, self.approach) for line in self.lines]
        points = [torch.as_tensor(line, dtype=torch.float32) for line in self.lines]
        # Padded with points so far away that they are never the nearest ones.
        self._points = pad_sequence(points, batch_first=True, padding_value=1e6)
        sections = [torch.as_tensor(of_line) for of_line in self.sections]
        self._section = pad_sequence(sections, batch_first=True)

    def locate(self, state: TensorDictBase) -> dict[str, Tensor]:
        """Return the track of each car and the nearest point of its middle line.

        Args:
            state: [B], of the env.

        Returns:
            The index of the `track` and the index of the `point`, [B] each.
        """
        track, position = state["info", "track"].squeeze(-1), state["info", "pose"][..., :2]
        points = self._points.to(position)[track]
        point = (points - position.unsqueeze(-2)).square().sum(-1).argmin(-1)
        return {"track": track, "point": point}

    def section(self, place: TensorDictBase) -> Tensor:
        """Return the section of each place as an index in SECTIONS, [B].

        Args:
            place: [B], entries as `locate` returns them.
        """
        return self._section.to(place["track"].device)[place["track"], place["point"]]

    def draw(self, data: Survey, folder: Path) -> None:
        """Draw a map of the tracks for each measure, and write the table along the tracks.

        Args:
            data: the measures.
            folder: of the maps and of the table, `listening.csv`, which is the last file.
        """
        table = self.table(data)
        for measure, title, label, name in drawn(data.measures):
            lines, values = self.measure_on_lines(data, table, measure)
            draw_listening_map(self.tracks, lines, values, folder / name, label=label, title=title)
        write_csv(table, folder / "listening.csv")

    def table(self, data: Survey) -> list[dict[str, Any]]:
        """Return one row per guide and bin of each track with a visited state.

        Args:
            data: the measures.

        Returns:
            Rows with `track`, `guide`, `bin`, `from` (m along the middle line), `x`, `y` (m),
            `curvature` (1/m) and `section` of the bin's middle, number of `states`, and means of
            `agreement`, `intervention` and `gradient`.
        """
        bins = [self._bins(line) for line in self.lines]
        track, point = data.place["track"], data.place["point"]
        places = zip(track.tolist(), point.tolist(), strict=True)
        bin_of_state = np.array([bins[index][nearest] for index, nearest in places])
        rows = []
        for row in data.means(track=track, bin=bin_of_state):
            index, line = row["track"], self.lines[row["track"]]
            within = np.flatnonzero(bins[index] == row["bin"])
            middle = within[len(within) // 2]
            step = np.linalg.norm(np.diff(line[: within[0] + 1], axis=0), axis=1)
            rows.append(
                row
                | {
                    "track": self.tracks[index].name,
                    "from": float(step.sum()),
                    "x": float(line[middle, 0]),
                    "y": float(line[middle, 1]),
                    "curvature": float(curvature(line)[middle]),
                    "section": SECTIONS[self.sections[index][middle]],
                }
            )
        return rows

    def measure_on_lines(
        self, data: Survey, table: Sequence[Mapping[str, Any]], measure: str
    ) -> tuple[list[Array], dict[str, list[Array]]]:
        """Return a driven line on each track, and the values of a measure along it.

        Args:
            data: the measures.
            table: the result of the method `table`.
            measure: its name.

        Returns:
            The line of the last car of each track, [T, 2] m; and by guide, for each track, the mean
            of the measure in the bin of each point of the line, [T].
        """
        means = {(row["track"], row["guide"], row["bin"]): row[measure] for row in table}
        lines: list[Array] = []
        values: dict[str, list[Array]] = {guide: [] for guide in data.guides}
        for middle_line, track in zip(self.lines, self.tracks, strict=True):
            line = _last_line(data, track.name)
            nearest = ((line[:, None] - middle_line) ** 2).sum(-1).argmin(1)
            bins = self._bins(middle_line)[nearest].tolist()
            lines.append(line)
            for guide in data.guides:
                of_line = [means.get((track.name, guide, k), np.nan) for k in bins]
                values[guide].append(np.array(of_line))
        return lines, values

    def _bins(self, line: Array) -> NDArray[np.int64]:
        """Return the bin of each point of a closed line, [P]: numbers from 0.

        All bins have about the same length.

        Args:
            line: [P, 2] m.
        """
        total = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1).sum()
        count = min(len(line), max(1, round(total / self.bin)))
        return np.arange(len(line)) * count // len(line)


def _last_line(data: Survey, track: str) -> Array:
    """Return the driven line of the last car of a track, [T, 2] m, at the measured states."""
    cars = [car for car, row in enumerate(data.result.episodes) if row["case"] == track]
    line: Array = data.result.histories["pose"][cars[-1]][:, :2]
    # The last point is the position after the last measured state.
    return line[: max(1, len(line) - 1)]
