"""Draw the last lap of the guide and of trained agents, on test tracks that are straightened.

The tracks are straightened along their middle line. Below each track is the smoothness of the
steering, |a - weighted mean of the last 20 actions|. The agents of the runs drive once more, in
their own environments; the guide is that of the first run.

    python -m coil_paper.figures.lines RUN [RUN ...] [--output FOLDER] [--tracks 3] [--policy last]
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from coil_paper.figures.world import marker
from coil_paper.reproduce.figures import Array
from coil_rl import EvaluationResult, Track, UserError, open_run
from coil_rl.envs import SIDES
from coil_rl.report import DrivenLines, markdown_table, style
from coil_studies.listening import LEFT, RIGHT, classify, smooth_line

INSIDE_COLOUR = "#eceff2"
HALF_WIDTH = 1.5  # m, of the straightened track
SPACING = 0.05  # m, of the middle line
RECORD = {"pose": ("info", "pose"), "smoothness": ("info", "smoothness")}
CONE: Any = {"ms": 3, "mec": style.INK, "mew": 0.3}


class StraightTrack:
    """Coordinates along and across the middle line of a track."""

    def __init__(self, track: Track) -> None:
        self.track = track
        self.line = smooth_line(track, SPACING, 0.3)
        edges = np.roll(self.line, -1, axis=0) - self.line
        lengths = np.linalg.norm(edges, axis=1)
        self.along, self.length = np.cumsum(lengths) - lengths, float(lengths.sum())
        self.kinds = classify(smooth_line(track, SPACING))
        headings = edges + np.roll(edges, 1, axis=0)
        self._headings = headings / np.linalg.norm(headings, axis=1, keepdims=True)
        self._tree = cKDTree(self.line)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Return the distance along the middle line and to its left, m, of points [N, 2]."""
        nearest = self._tree.query(points)[1]
        offset, heading = points - self.line[nearest], self._headings[nearest]
        along = (self.along[nearest] + (offset * heading).sum(1)) % self.length
        return along, heading[:, 0] * offset[:, 1] - heading[:, 1] * offset[:, 0]

    def last_lap(self, line: Array, smoothness: Array) -> list[Array]:
        """Return along, left and the smoothed smoothness of the last lap.

        NaN separates the two ends of the picture.
        """
        along, left = self(line)
        distance = np.unwrap(along, period=self.length)
        step = float(np.median(np.linalg.norm(np.diff(line, axis=0), axis=1)))
        values = [along, left, gaussian_filter1d(smoothness, 1.0 / step)]
        shown = [array[distance > distance[-1] - self.length] for array in values]
        jumps = np.flatnonzero(np.abs(np.diff(shown[0])) > self.length / 2) + 1
        return [np.insert(array, jumps, np.nan) for array in shown]

    def path_ratio(self, line: Array) -> float:
        """Return the driven distance per distance along the centre line."""
        along, _ = self(line)
        laps = np.diff(np.unwrap(along, period=self.length)).sum() / self.length
        passed = laps * self.track.length
        return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() / passed)


def drive(
    folders: Sequence[Path], count: int, policy: str
) -> tuple[Sequence[Track], dict[str, EvaluationResult]]:
    """Return test tracks, and the drives of the guide and of every agent there.

    Args:
        folders: of finished runs; tracks and guide are those of the first one.
        policy: of each run, "last" or "handed_over".

    Raises:
        UserError: for a folder without a run, and for one in another world than that of the cones.
    """
    runs = [open_run(folder) for folder in folders]
    trial = runs[0].trial
    pictures = [each for each in trial.pictures if isinstance(each, DrivenLines)]
    if not pictures:
        raise UserError(
            f"{folders[0]} is no run in the cone world, so that it has no lines to draw"
        )
    tracks = pictures[0].tracks[:count]
    cases = [track.name for track in tracks]
    evaluation = replace(trial.evaluation, cases=cases, record=RECORD)
    drives = dict(trial.guide_results(evaluation, []))
    for run in runs:
        env = run.make_env(len(tracks), "test")
        name = run.label if run.label not in drives else f"{run.label}, seed {run.seed}"
        drives[name] = evaluation.run(env, run.policy(env, policy))
    return tracks, drives


def draw_map(axes: Axes, straight: StraightTrack) -> None:
    """Draw the boundaries of a track, with the distance along the middle every 20 m."""
    axes.set_title(straight.track.name, size=9, color=style.QUIET)
    axes.set_aspect("equal")
    axes.axis("off")
    for side in SIDES:
        ring = straight.track.boundary(side, 0.2)
        axes.plot(*np.vstack([ring, ring[:1]]).T, color=style.KERB, lw=0.8)
    for distance in np.arange(0, straight.length - 10, 20):
        point = straight.line[np.searchsorted(straight.along, distance)]
        axes.plot(*point, "o", ms=2.5, color=style.INK)
        axes.annotate(f"{distance:.0f}", point, (3, 3), textcoords="offset points", size=7)


def draw_straight(axes: Axes, straight: StraightTrack) -> None:
    """Draw the cones of a straightened track and the insides of its turns."""
    for kind, edge in ((LEFT, HALF_WIDTH), (RIGHT, -HALF_WIDTH)):
        axes.fill_between(
            straight.along,
            0,
            edge,
            where=straight.kinds == kind,
            color=INSIDE_COLOUR,
            lw=0,
            zorder=1,
        )
    axes.axhline(0, color=style.KERB, lw=0.6, zorder=2)
    for cones, colour in (
        (straight.track.left, style.LEFT_CONE),
        (straight.track.right, style.RIGHT_CONE),
    ):
        axes.plot(*straight(cones), "o", mfc=colour, zorder=3, **CONE)
    axes.set(xlim=(0, straight.length), ylim=(-HALF_WIDTH, HALF_WIDTH), yticks=(-1, 0, 1))
    axes.set_ylabel("left (m)", size=8)


def draw(
    path: Path, tracks: Sequence[StraightTrack], drives: Mapping[str, EvaluationResult]
) -> None:
    """Draw all tracks and drives."""
    strokes = style.strokes(drives)
    handles = style.handles(strokes, lw=1.8)
    cones = zip(SIDES, (style.LEFT_CONE, style.RIGHT_CONE), strict=True)
    handles += [
        marker("o", f"{side} cones", 5, mfc=colour, mec=style.INK) for side, colour in cones
    ]
    handles += [
        Patch(fc=INSIDE_COLOUR, label="inside of a turn"),
        marker("X", "crash", 5, color=style.INK),
    ]
    with style.picture(
        path, "Driven lines on test tracks", handles, 0.75 + 2.3 * len(tracks)
    ) as figure:
        ratios = [1.8, 0.8] * len(tracks)
        grid = figure.add_gridspec(
            2 * len(tracks), 2, width_ratios=(1.0, 3.2), height_ratios=ratios
        )
        for index, straight in enumerate(tracks):
            draw_map(figure.add_subplot(grid[2 * index : 2 * index + 2, 0]), straight)
            above = figure.add_subplot(grid[2 * index, 1])
            below = figure.add_subplot(grid[2 * index + 1, 1], sharex=above)
            draw_straight(above, straight)
            for name, result in drives.items():
                stroke = {"color": strokes[name].colour, "ls": strokes[name].linestyle}
                pose, rough = (result.histories[key][index] for key in RECORD)
                along, left, rough = straight.last_lap(pose[:, :2], rough)
                above.plot(along, left, lw=1.2, zorder=4, **stroke)
                below.plot(along, rough, lw=1.0, **stroke)
                if result.episodes[index]["crashed"]:
                    above.plot(
                        along[-1],
                        left[-1],
                        "X",
                        ms=7,
                        mfc=stroke["color"],
                        mec=style.BACKGROUND,
                        zorder=5,
                    )
            for axes in (above, below):
                style.lighten(axes)
                axes.tick_params(length=0, labelsize=7, labelbottom=axes is below)
            below.set_ylim(bottom=0)
            below.set_ylabel("smoothness", size=8)
        below.set_xlabel("along the middle (m)", size=8)


def main() -> None:
    """Draw lines.png and print the measures of each drive."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", type=Path, nargs="+", help="folders of finished runs")
    parser.add_argument(
        "--output", type=Path, default=Path("outputs/figures"), help="output folder"
    )
    parser.add_argument("--tracks", type=int, default=3, help="number of test tracks")
    parser.add_argument("--policy", choices=("last", "handed_over"), default="last")
    options = parser.parse_args()
    try:
        tracks, drives = drive(options.runs, options.tracks, options.policy)
    except UserError as error:
        parser.error(str(error))
    straight = [StraightTrack(track) for track in tracks]
    draw(options.output / "lines.png", straight, drives)
    rows = []
    for name, result in drives.items():
        for index, (episode, of_track) in enumerate(zip(result.episodes, straight, strict=True)):
            line = result.histories["pose"][index][:, :2]
            ratio = of_track.path_ratio(line) if episode["laps"] else None
            rows.append({"driver": name, **episode, "path": ratio})
    columns = {
        "driver": ("driver", ""),
        "case": ("track", ""),
        "reward": ("reward", ".1f"),
        "lap_time": ("lap (s)", ".2f"),
        "smoothness": ("smoothness", ".3f"),
        "path": ("path / centre line", ".3f"),
        "crashed": ("crashed", ""),
    }
    print(f"{markdown_table(rows, columns)}\n{options.output / 'lines.png'}")


if __name__ == "__main__":
    main()
