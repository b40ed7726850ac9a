import itertools
import math

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from ovals import oval_line, oval_track, ring_track
from PIL import Image, ImageSequence

from coil_rl.report import animate_lines, draw_lines, draw_listening_map, style
from coil_rl.report.lines import MEASURE_COLOURS
from coil_rl.report.track_map import TrackMap

TRACKS = [ring_track("small", 8.0), ring_track("large", 11.0)]


def driven(radius, seconds, rate=24):
    angle = 2 / radius * np.arange(round(seconds * rate)) / rate
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


LINES = {"guide": [driven(8, 30), driven(11, 40)], "agent": [driven(7.6, 28), driven(10.6, 12)]}


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(np.int64)


def count(image, colour):
    return int((np.abs(image - 255 * np.array(to_rgb(colour))).max(axis=-1) < 3).sum())


def test_figure_shows_tracks_cones_and_drivers(tmp_path):
    draw_lines(TRACKS, LINES, tmp_path / "lines.png")
    image = pixels(tmp_path / "lines.png")
    assert image.shape[1] == style.WIDTH * style.RESOLUTION
    for colour in (style.ASPHALT, style.LEFT_CONE, style.RIGHT_CONE, style.GUIDES[0], style.AGENTS[0]):
        assert count(image, colour)
    assert list(tmp_path.iterdir()) == [tmp_path / "lines.png"]


def test_crash_is_marked_at_the_end_of_the_line(tmp_path):
    draw_lines(TRACKS, LINES, tmp_path / "without.png", crashed={"agent": [False, False]})
    draw_lines(TRACKS, LINES, tmp_path / "crash.png", crashed={"agent": [False, True]})
    changed = (pixels(tmp_path / "without.png") != pixels(tmp_path / "crash.png")).any(axis=-1)
    columns = np.flatnonzero(changed[changed.shape[0] // 4 :].any(axis=0))  # below the legend
    track_map = TrackMap(TRACKS)
    expected = (LINES["agent"][1][-1] + track_map.offsets[1])[0] * track_map.scale * style.RESOLUTION
    assert abs(columns.mean() - expected) < 3
    assert np.ptp(columns) < 40


@pytest.mark.parametrize("lines", [{}, {"agent": [[], []]}, *({"agent": [driven(8, 10)[:n], []]} for n in (1, 2))])
def test_lines_may_be_short_or_missing(lines, tmp_path):
    crashed = {label: [True, True] for label in lines}
    draw_lines(TRACKS, lines, tmp_path / "lines.png", crashed=crashed)
    animate_lines(TRACKS, lines, tmp_path / "lines.gif", rate=24, crashed=crashed)
    assert count(pixels(tmp_path / "lines.png"), style.ASPHALT)
    assert pixels(tmp_path / "lines.gif").shape[1] == 800


def test_arrays_tensors_and_lists_give_the_same_figure_without_rows_that_are_not_finite(tmp_path):
    line = driven(8, 10)
    with_gaps = np.insert(line, [0, 50, len(line)], math.nan, axis=0)
    images = []
    for index, given in enumerate([line, torch.from_numpy(line), line.tolist(), with_gaps]):
        draw_lines(TRACKS[:1], {"agent": [given]}, tmp_path / f"{index}.png")
        images.append(pixels(tmp_path / f"{index}.png"))
    assert all((image == images[0]).all() for image in images)


def test_dashes_of_two_laps_coincide(tmp_path):
    angle = np.linspace(0, 2 * np.pi, 600, endpoint=False)
    # Half a step before the finish line, so that both laps begin alike.
    lap = np.roll(8 * np.stack([np.cos(angle), np.sin(angle)], axis=1), 3, axis=0)
    dark = []
    for laps in (1, 2):
        draw_lines(TRACKS[:1], {"guide": [np.vstack([lap] * laps)]}, tmp_path / f"{laps}.png")
        dark.append(int((pixels(tmp_path / f"{laps}.png").max(axis=-1) < 120).sum()))
    assert dark[1] < 1.15 * dark[0]


def test_animation_moves_repeats_and_is_small(tmp_path):
    path = tmp_path / "lines.gif"
    animate_lines(TRACKS, LINES, path, rate=24, crashed={"agent": [False, True]}, seconds=1)
    with Image.open(path) as image:
        assert image.info["loop"] == 0
        frames = [np.asarray(frame.convert("RGB")).astype(np.int64) for frame in ImageSequence.Iterator(image)]
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert durations == [50] * 20 + [1200]
    assert all((before != after).any() for before, after in itertools.pairwise(frames))
    assert (frames[0][0, 0] == 255).all()
    assert all(count(frames[5], colour) for colour in (style.ASPHALT, style.GUIDES[0], style.AGENTS[0]))
    assert path.stat().st_size < 250_000
    assert list(tmp_path.iterdir()) == [path]


def test_short_animation_has_the_speed_of_the_drive(tmp_path):
    animate_lines(TRACKS[:1], {"agent": [driven(8, 0.5)]}, tmp_path / "short.gif", rate=24)
    with Image.open(tmp_path / "short.gif") as image:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert sum(durations[:-1]) <= 500


def test_driver_outside_of_the_map_is_no_error(tmp_path):
    away = np.array([8.0, 0.0]) + np.outer(np.arange(100), [1e4, -1e4])
    draw_lines(TRACKS[:1], {"agent $\\frac$": [away]}, tmp_path / "away.png")
    animate_lines(TRACKS[:1], {"agent": [away]}, tmp_path / "away.gif", rate=24, seconds=1)
    assert pixels(tmp_path / "away.gif").shape[1] == 800


@pytest.mark.parametrize("suffix", ["svg", "pdf"])
def test_suffix_decides_the_format(suffix, tmp_path):
    draw_lines(TRACKS[:1], {"agent": [driven(8, 10)]}, tmp_path / f"lines.{suffix}")
    assert suffix.encode() in (tmp_path / f"lines.{suffix}").read_bytes()[:400].lower()


@pytest.mark.parametrize(
    ("lines", "crashed", "name", "message"),
    [
        ({"agent": [driven(8, 1)]}, {}, "x.png", "'agent' has 1 lines and 2 crash marks for 2 tracks"),
        ({"agent": [[], []]}, {"agent": [True] * 3}, "x.png", "'agent' has 2 lines and 3 crash marks for 2 tracks"),
        ({"agent": [[], np.zeros((5, 3))]}, {}, "x.png", r"'agent' has the shape \[5, 3\]; it takes \[T, 2\]"),
        (LINES, {}, "x.xyz", "xyz"),
    ],
)
def test_lines_that_do_not_fit_are_an_error_and_leave_no_file(lines, crashed, name, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        draw_lines(TRACKS, lines, tmp_path / name, crashed=crashed)
    assert not list(tmp_path.iterdir())


OVALS = [oval_track("one"), oval_track("two", clockwise=True)]
OVAL_LINES = [oval_line(10), oval_line(10) * [1, -1]]


def constant(*values):
    return [np.full(len(line), value) for line, value in zip(OVAL_LINES, values, strict=True)]


def measured(path, values, **options):
    """Draw a listening map; return its height and the numbers of pixels of the strongest and the weakest colour."""
    draw_listening_map(OVALS, OVAL_LINES, values, path, label="moved", **options)
    image = pixels(path)
    return image.shape[0], *(count(image[:-80], MEASURE_COLOURS(end)) for end in (1.0, 0.0))


def test_guides_share_the_colours_of_the_listening_map(tmp_path):
    height, strong, weak = measured(tmp_path / "one.png", {"used": constant(0.4, 0.4)})
    both = {"used": constant(0.4, 0.4), "ignored": constant(0, 0)}
    tall, strong_of_two, weak_of_two = measured(tmp_path / "two.png", both, title="t")
    assert tall > 1.4 * height
    assert strong == pytest.approx(strong_of_two, rel=0.1) == pytest.approx(weak_of_two, rel=0.1)
    assert weak == 0
    _, half, _ = measured(tmp_path / "half.png", {"used": constant(np.nan, 0.4)})
    assert half == pytest.approx(strong / 2, rel=0.1)
    measured(tmp_path / "nan.png", {"used": constant(np.nan, np.nan)})


@pytest.mark.parametrize("values", [constant(1, 1)[:1], [np.zeros(3), np.zeros(3)]])
def test_values_of_the_listening_map_must_match_the_lines(values, tmp_path):
    with pytest.raises(ValueError, match="the values of 'guide' have the shapes"):
        draw_listening_map(OVALS, OVAL_LINES, {"guide": values}, tmp_path / "map.png", label="moved")
    assert not list(tmp_path.iterdir())
