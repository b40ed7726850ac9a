import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageSequence

from coil_rl.envs.track import Track
from coil_rl.report import style
from coil_rl.report.lines import animate_lines, draw_lines
from coil_rl.report.scene import Scene

Array = NDArray[np.float64]


def circle(radius: float, points: int, turns: float = 1) -> Array:
    angle = np.linspace(0, 2 * np.pi * turns, points, endpoint=False)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def ring(name: str, radius: float = 8.0) -> Track:
    return Track(name, left=circle(radius - 1, 24), right=circle(radius + 1, 28))


def driven(radius: float, seconds: float, rate: float = 24) -> Array:
    return circle(radius, round(seconds * rate), seconds * 2 / (2 * np.pi * radius))


def picture(path: Path) -> NDArray[np.int64]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(np.int64)


def shows(pixels: NDArray[np.int64], colour: str) -> bool:
    return bool((np.abs(pixels - 255 * np.array(to_rgb(colour))).max(axis=-1) < 3).any())


@pytest.fixture(scope="module")
def tracks() -> list[Track]:
    return [ring("small"), ring("large", 11.0)]


@pytest.fixture(scope="module")
def lines() -> dict[str, list[Array]]:
    return {"guide": [driven(8, 30), driven(11, 40)], "agent": [driven(7.6, 28), driven(10.6, 12)]}


def test_a_picture_shows_tracks_cones_and_drivers(
    tracks: list[Track], lines: dict[str, list[Array]], tmp_path: Path
) -> None:
    draw_lines(tracks, lines, tmp_path / "lines.png", title="Two laps")
    pixels = picture(tmp_path / "lines.png")
    assert pixels.shape[1] == style.WIDTH * style.RESOLUTION
    assert 300 < pixels.shape[0] < pixels.shape[1]
    for colour in (style.ASPHALT, style.LEFT_CONE, style.RIGHT_CONE, style.GUIDES[0], style.AGENTS[0]):
        assert shows(pixels, colour)
    assert list(tmp_path.iterdir()) == [tmp_path / "lines.png"]


def test_tracks_without_drivers_are_a_picture_too(tracks: list[Track], tmp_path: Path) -> None:
    draw_lines(tracks, {}, tmp_path / "tracks.png")
    assert shows(picture(tmp_path / "tracks.png"), style.ASPHALT)
    animate_lines(tracks, {}, tmp_path / "tracks.gif", rate=24)
    assert shows(picture(tmp_path / "tracks.gif"), style.ASPHALT)


def test_a_crash_is_marked_where_the_line_ends(
    tracks: list[Track], lines: dict[str, list[Array]], tmp_path: Path
) -> None:
    marks = {"agent": [False, True]}
    draw_lines(tracks, lines, tmp_path / "without.png")
    draw_lines(tracks, lines, tmp_path / "with.png", crashed={"agent": [False, False]})
    assert (picture(tmp_path / "without.png") == picture(tmp_path / "with.png")).all()
    draw_lines(tracks, lines, tmp_path / "crash.png", crashed=marks)
    changed = (picture(tmp_path / "without.png") != picture(tmp_path / "crash.png")).any(axis=-1)
    below_legend = changed[changed.shape[0] // 4 :]
    scene = Scene(tracks, dpi=style.RESOLUTION)
    expected_column = scene.pixels(1, lines["agent"][1][-1:])[0, 0]
    columns = np.flatnonzero(below_legend.any(axis=0))
    assert abs(columns.mean() - expected_column) < 3
    assert np.ptp(columns) < 40


@pytest.mark.parametrize("count", [0, 1, 2])
def test_short_lines_are_drawn_as_far_as_they_go(tracks: list[Track], count: int, tmp_path: Path) -> None:
    lines: dict[str, list[ArrayLike]] = {"agent": [driven(8, 10)[:count], []]}
    marks = {"agent": [True, True]}
    draw_lines(tracks, lines, tmp_path / "lines.png", crashed=marks)
    animate_lines(tracks, lines, tmp_path / "lines.gif", rate=24, crashed=marks)
    assert picture(tmp_path / "lines.png").shape[1] == 1600
    assert picture(tmp_path / "lines.gif").shape[1] == 800


def test_rows_that_are_not_finite_are_left_out(tracks: list[Track], tmp_path: Path) -> None:
    line = driven(8, 10)
    gaps = np.insert(line, [0, 50, len(line)], math.nan, axis=0)
    draw_lines(tracks[:1], {"agent": [line]}, tmp_path / "line.png")
    draw_lines(tracks[:1], {"agent": [gaps]}, tmp_path / "gaps.png")
    assert (picture(tmp_path / "line.png") == picture(tmp_path / "gaps.png")).all()


def test_tensors_and_lists_are_lines(tracks: list[Track], tmp_path: Path) -> None:
    line = driven(8, 10)
    draw_lines(tracks[:1], {"agent": [line]}, tmp_path / "array.png")
    draw_lines(tracks[:1], {"agent": [torch.from_numpy(line)]}, tmp_path / "tensor.png")
    draw_lines(tracks[:1], {"agent": [line.tolist()]}, tmp_path / "list.png")
    assert (picture(tmp_path / "array.png") == picture(tmp_path / "tensor.png")).all()
    assert (picture(tmp_path / "array.png") == picture(tmp_path / "list.png")).all()


def test_dashes_of_a_second_lap_lie_on_those_of_the_first(tracks: list[Track], tmp_path: Path) -> None:
    lap = circle(8, 600)
    # Half a step before the finish, so that the second lap starts where the first one did.
    lap = np.roll(lap, 3, axis=0)
    draw_lines(tracks[:1], {"guide": [lap]}, tmp_path / "one.png")
    draw_lines(tracks[:1], {"guide": [np.vstack([lap, lap])]}, tmp_path / "two.png")
    one, two = (int((picture(tmp_path / name).max(axis=-1) < 120).sum()) for name in ("one.png", "two.png"))
    assert two < 1.15 * one


def test_many_tracks_stand_in_rows_of_three_at_one_scale() -> None:
    tracks = [ring(str(index), 8 + index % 3) for index in range(7)]
    scene = Scene(tracks, dpi=style.RESOLUTION)
    corners = np.array([scene.pixels(index, np.array([[-12.0, 12.0], [12.0, 12.0]])) for index in range(7)])
    widths = corners[:, 1, 0] - corners[:, 0, 0]
    np.testing.assert_allclose(widths, widths[0])
    middles = np.array([scene.pixels(index, np.zeros((1, 2)))[0] for index in range(7)])
    gaps = np.linalg.norm(middles[:, None] - middles, axis=-1) + 1e9 * np.eye(7)
    assert gaps.min() > 17 * scene.scale * style.RESOLUTION
    tops = middles[:, 1] - np.array([9 + index % 3 for index in range(7)]) * scene.scale * style.RESOLUTION
    assert len(np.unique(tops.round())) == 3


def test_a_tall_track_does_not_make_a_tall_picture(tmp_path: Path) -> None:
    stretch = np.array([1.0, 4.0])
    tall = Track("tall", left=circle(7, 40) * stretch, right=circle(9, 44) * stretch)
    draw_lines([tall], {}, tmp_path / "tall.png")
    height, width, _ = picture(tmp_path / "tall.png").shape
    assert height < 0.75 * width


def test_an_animation_moves_loops_and_is_small(
    tracks: list[Track], lines: dict[str, list[Array]], tmp_path: Path
) -> None:
    path = tmp_path / "lines.gif"
    animate_lines(tracks, lines, path, rate=24, crashed={"agent": [False, True]}, title="Two laps", seconds=2, fps=10)
    with Image.open(path) as image:
        assert image.info["loop"] == 0
        assert image.size[0] == 800
        frames = [np.asarray(frame.convert("RGB")).astype(np.int64) for frame in ImageSequence.Iterator(image)]
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert len(frames) == 21
    assert durations == [100] * 20 + [1200]
    for before, after in itertools.pairwise(frames):
        assert (before != after).any()
    assert (frames[0][0, 0] == 255).all()
    assert all(shows(frames[5], colour) for colour in (style.ASPHALT, style.GUIDES[0], style.AGENTS[0]))
    assert path.stat().st_size < 250_000
    assert list(tmp_path.iterdir()) == [path]


def test_a_short_drive_is_not_shown_slower_than_it_was(tracks: list[Track], tmp_path: Path) -> None:
    animate_lines(tracks[:1], {"agent": [driven(8, 0.5)]}, tmp_path / "short.gif", rate=24, seconds=12, fps=20)
    with Image.open(tmp_path / "short.gif") as image:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert sum(durations[:-1]) <= 500


def test_a_driver_who_left_the_picture_does_no_harm(tracks: list[Track], tmp_path: Path) -> None:
    away = np.array([8.0, 0.0]) + np.outer(np.arange(100), [1e4, -1e4])
    draw_lines(tracks[:1], {"agent": [away]}, tmp_path / "away.png")
    animate_lines(tracks[:1], {"agent": [away]}, tmp_path / "away.gif", rate=24, seconds=1, fps=10)
    assert picture(tmp_path / "away.gif").shape[1] == 800


@pytest.mark.parametrize("ending", ["svg", "pdf"])
def test_a_picture_has_the_format_of_its_ending(tracks: list[Track], ending: str, tmp_path: Path) -> None:
    draw_lines(tracks[:1], {"agent": [driven(8, 10)]}, tmp_path / f"lines.{ending}")
    assert ending.encode() in (tmp_path / f"lines.{ending}").read_bytes()[:400].lower()


def test_labels_are_never_read_as_mathematics(tracks: list[Track], tmp_path: Path) -> None:
    draw_lines(tracks[:1], {"agent $\\frac$ 5": [[]]}, tmp_path / "lines.png", title="100 $ and $x_")
    assert (tmp_path / "lines.png").exists()


def test_lines_must_match_the_tracks(tracks: list[Track], tmp_path: Path) -> None:
    path = tmp_path / "lines.png"
    with pytest.raises(ValueError, match=r"'agent' has 1 lines for 2 tracks \(small, large\)"):
        draw_lines(tracks, {"agent": [driven(8, 1)]}, path)
    with pytest.raises(ValueError, match=r"'agent' has 3 crash marks for 2 tracks"):
        draw_lines(tracks, {"agent": [[], []]}, path, crashed={"agent": [True, False, True]})
    with pytest.raises(ValueError, match=r"crash marks of 'agnet' but no lines; lines are given of: agent"):
        draw_lines(tracks, {"agent": [[], []]}, path, crashed={"agnet": [True, False]})
    with pytest.raises(ValueError, match=r"'agent' on 'large' has the shape \[5, 3\]; it takes \[T, 2\]"):
        draw_lines(tracks, {"agent": [[], np.zeros((5, 3))]}, path)
    with pytest.raises(ValueError, match="at least one track"):
        draw_lines([], {}, path)
    with pytest.raises(ValueError, match="rate must be above 0, got 0"):
        animate_lines(tracks, {}, path, rate=0)
    assert list(tmp_path.iterdir()) == []


def test_a_drawing_that_fails_leaves_no_file(
    tracks: list[Track], lines: dict[str, list[Array]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ValueError, match="xyz"):
        draw_lines(tracks, lines, tmp_path / "lines.xyz")

    calls = iter(range(100))

    def fail(frame: Image.Image, text: str) -> None:
        if next(calls) == 3:
            raise RuntimeError("no more ink")

    monkeypatch.setattr("coil_rl.report.lines.draw_clock", fail)
    with pytest.raises(RuntimeError, match="no more ink"):
        animate_lines(tracks, lines, tmp_path / "lines.gif", rate=24, seconds=1, fps=10)
    assert list(tmp_path.iterdir()) == []
