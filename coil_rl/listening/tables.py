"""The numbers of a survey, by kind of place and along the tracks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coil_rl.listening.ablation import Ablation
from coil_rl.listening.places import PLACES, Places, curvature
from coil_rl.listening.survey import Survey
from coil_rl.train.evaluation import summarise

EVERYWHERE = "everywhere"


def by_place(
    found: Survey, places: Places, ablated: Mapping[Ablation, Sequence[Mapping[str, Any]]]
) -> list[dict[str, Any]]:
    """A row for each guide everywhere and at each kind of place: means over states, and what its silence cost.

    Args:
        found: of the agent.
        places: of its tracks.
        ablated: the episodes of each ablation.

    Returns:
        Rows with `guide`, `place`, `share` of the states, `agreement`, `intervention`, `gradient`, `lost` (return) and
        `completed` (share, without the guide there). A kind of place where nobody was is left out.
    """
    kind = _kind(found, places)
    intact = _mean(found.drive.episodes)
    rows = []
    for one, episodes in ablated.items():
        at = np.ones(len(kind), dtype=bool) if one.place is None else kind == one.place
        if at.any():
            rows.append(
                {"guide": found.guides[one.guide], "place": EVERYWHERE if one.place is None else PLACES[one.place]}
                | {"share": float(at.mean())}
                | {name: float(values[at, one.guide].mean()) for name, values in _measures(found).items()}
                | {"lost": intact["reward"] - _mean(episodes)["reward"], "completed": _mean(episodes)["completed"]}
            )
    return rows


def along(found: Survey, places: Places, bin_length: float = 1.0) -> list[dict[str, Any]]:
    """A row for each guide and each bin of each track in which a car was.

    Args:
        found: of the agent.
        places: of its tracks.
        bin_length: in m of the middle line, but for what rounding to a whole number of bins takes.

    Returns:
        Rows with `track`, `guide`, `bin`, `from` (m along the middle line), of the bin's middle `x`, `y` (m),
        `curvature` (1/m) and `place`, the number of `states`, and the means of `agreement`, `intervention` and
        `gradient`.
    """
    rows = []
    for index, track in enumerate(places.tracks):
        line, here = places.lines[index], found.track.cpu().numpy() == index
        bins = _bins(line, bin_length)
        bin_of_state = bins[found.point.cpu().numpy()[here]]
        states = np.bincount(bin_of_state, minlength=bins[-1] + 1)
        middles = np.searchsorted(bins, np.arange(bins[-1] + 1)) + np.bincount(bins) // 2
        step, bend = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1), curvature(line)
        for slot, guide in enumerate(found.guides):
            sums = {name: np.bincount(bin_of_state, values[here, slot]) for name, values in _measures(found).items()}
            rows += [
                {
                    "track": track.name,
                    "guide": guide,
                    "bin": place,
                    "from": float(step[: np.searchsorted(bins, place)].sum()),
                    "x": float(line[middles[place], 0]),
                    "y": float(line[middles[place], 1]),
                    "curvature": float(bend[middles[place]]),
                    "place": PLACES[places.kinds[index][middles[place]]],
                    "states": int(states[place]),
                    **{name: float(of_bin[place] / states[place]) for name, of_bin in sums.items()},
                }
                for place in np.flatnonzero(states).tolist()
            ]
    return rows


def along_lines(
    found: Survey, places: Places, measure: str, bin_length: float = 1.0
) -> tuple[list[NDArray[np.float64]], dict[str, list[NDArray[np.float64]]]]:
    """One driven line a track, and for each guide what `along` says of a measure at its points.

    Args:
        found: of the agent.
        places: of its tracks.
        measure: `agreement`, `intervention` or `gradient`.
        bin_length: as for `along`.

    Returns:
        Lines [T, 2] m, of the last car of each track, and by guide the values [T] of each line.
    """
    rows, lines = along(found, places, bin_length), []
    values: dict[str, list[NDArray[np.float64]]] = {guide: [] for guide in found.guides}
    for line, track in zip(places.lines, places.tracks, strict=True):
        cars = [car for car, row in enumerate(found.drive.episodes) if row["track"] == track.name]
        driven = found.drive.lines[cars[-1]]
        # The line holds where the car was after its steps: the last point is no state that was measured.
        driven = driven[: max(1, len(driven) - 1)]
        near = ((driven[:, None] - line) ** 2).sum(-1).argmin(1)
        bin_of_point = _bins(line, bin_length)[near]
        lines.append(driven)
        for guide in found.guides:
            by_bin = {row["bin"]: row[measure] for row in rows if (row["track"], row["guide"]) == (track.name, guide)}
            values[guide].append(np.array([by_bin.get(place, np.nan) for place in bin_of_point.tolist()]))
    return lines, values


def _measures(found: Survey) -> dict[str, NDArray[np.float64]]:
    return {name: values.cpu().double().numpy() for name, values in found.measures.items()}


def _kind(found: Survey, places: Places) -> NDArray[np.int64]:
    track, point = found.track.cpu().numpy(), found.point.cpu().numpy()
    kind = np.empty_like(point)
    for index, of_track in enumerate(places.kinds):
        kind[track == index] = of_track[point[track == index]]
    return kind


def _mean(episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return summarise([dict(row) for row in episodes])[-1]


def _bins(line: NDArray[np.float64], length: float) -> NDArray[np.int64]:
    """The bin of each point of a closed line [P], from 0 on, all of them about equally long."""
    total = np.linalg.norm(np.roll(line, -1, axis=0) - line, axis=1).sum()
    count = min(len(line), max(1, round(total / length)))
    return np.arange(len(line)) * count // len(line)
