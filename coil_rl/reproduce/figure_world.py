"""What a car of the cone world sees and what the guide makes of it (sections 4.1 and A.1), at some moments."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from coil_rl.envs.level_files import shipped_track
from coil_rl.envs.sight import SAMPLES
from coil_rl.envs.track import SIDES
from coil_rl.report import markdown_table, write_csv
from coil_rl.reproduce.facing_up import rows_of_places, rows_of_samples
from coil_rl.reproduce.figure_world_look import Look, looks
from coil_rl.reproduce.figure_world_picture import draw
from coil_rl.reproduce.result import NO_RUNS, Result, Runs

MOMENTS = {"straight": 10.5, "right bend": 17.5, "left bend": 4.75, "left boundary lost": 5.33}

COLUMNS = {
    "name": ("moment", ""),
    "seconds": ("after (s)", ".2f"),
    "left": ("left cones", "d"),
    "right": ("right cones", "d"),
    "midpoints": ("midpoints", "d"),
    "targets": ("targets", "d"),
    "distance": ("d (m)", ".2f"),
    "angle": ("α (deg)", ".1f"),
    "advice": ("advice β (deg)", ".1f"),
    "steering": ("steering before (deg)", ".1f"),
}


class FigureWorld(Result):
    """Moments of the guide's drive: cones in sight, the observation, the guide's path, target and advice.

    Args:
        track: a shipped one, by its name.
        moments: s since the start, by the names of the panels.

    Raises:
        ValueError: for a track that does not exist, no moments, or a moment before the start.
    """

    def __init__(self, track: str = "test_3", moments: Mapping[str, float] = MOMENTS) -> None:
        self.track = shipped_track(track)
        if not moments:
            raise ValueError("moments is empty; give at least one as {name: seconds since the start}")
        for name, seconds in moments.items():
            if not 0 <= seconds < math.inf:
                raise ValueError(f"moments.{name}={seconds} must be a finite number of seconds, at least 0")
        self.moments = dict(moments)

    def make(self, stem: Path, runs: Runs = NO_RUNS) -> str:
        """Make it: see `Result`."""
        found = looks(self.track, self.moments)
        write_csv([row for look in found for row in _rows(look)], stem.with_suffix(".csv"))
        title = f"What a car sees and what its guide advises ({self.track.name})"
        draw(found, stem.with_suffix(".png"), title)
        return _page(found, self.track.name)


def _rows(look: Look) -> Iterator[dict[str, object]]:
    """Every place that the picture shows, in order, and what the observation says of the samples."""
    places = {f"cone {side}": cones for side, cones in zip(SIDES, look.seen, strict=True)}
    places |= {f"boundary {side}": curve for side, curve in zip(SIDES, look.estimate, strict=True)}
    places |= look.plan
    moment = {"moment": look.name, "seconds": look.seconds}
    yield moment | {"part": "advice", "degrees": look.advice}
    yield moment | {"part": "steering before", "degrees": look.steering}
    for row in (*rows_of_samples(look.samples, look.observation), *rows_of_places(places)):
        yield moment | row


def _page(found: Sequence[Look], track: str) -> str:
    rows = []
    for look in found:
        row: dict[str, object] = {"name": look.name, "seconds": look.seconds}
        row |= {side: len(cones) for side, cones in zip(SIDES, look.seen, strict=True)}
        row |= {"midpoints": len(look.plan["midpoint"]), "targets": len(look.plan["target"])}
        for x, y in look.plan["steered for"]:
            row |= {"distance": math.hypot(x, y), "angle": math.degrees(math.atan2(y, x))}
        rows.append({"distance": None, "angle": None} | row | {"advice": look.advice, "steering": look.steering})
    numbers = [
        {"sample": f"{SIDES[number // SAMPLES]} {number + 1}"}
        | {look.name: "{:.3f}, {:.3f}".format(*look.observation[2 * number : 2 * number + 2]) for look in found}
        for number in range(2 * SAMPLES)
    ]
    columns = {"sample": ("r, θ of sample", "")} | {look.name: (look.name, "") for look in found}
    return "\n\n".join(
        [
            f"## What a car sees and what its guide advises ({track})",
            "The guide drives; each panel is what the car sees at a moment, the car facing up.",
            markdown_table(rows, COLUMNS),
            "A cone is in sight within 7 m and 60° to either side of the heading (the sector). A smoothing spline "
            "through the cones of a side in sight, nearest first, is the car's estimate of that boundary; grey is the "
            "track as it is. Five samples of each, at equal steps of the spline's parameter, are the 20 numbers of the "
            "observation, r = 2 distance / 7 m - 1 and θ = bearing / 120°, both clipped to ±1:",
            markdown_table(numbers, columns),
            "Of a side with fewer than two cones in sight the last samples are remembered where they are in the world, "
            "and told as the car would see them from here (hollow diamonds). The guide joins left and right cones "
            "closer than 4 m to midpoints, lays a smoother spline through them, sets targets about a metre apart on it "
            "and steers for the nearest one that is ahead and farther than 0.625 m: at the distance d and the bearing "
            "α (degrees, left is positive) it advises β = (160° / π) atan(α / d^1.8), equation 103. The arrow is β. "
            "The guide remembers nothing but the steering now in force: whenever cones come into sight or leave it, "
            "path and targets are laid anew, and the advice may jump.",
        ]
    )
