import itertools
import math

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from ovals import ring_track
from PIL import Image, ImageSequence

from coil_rl.cones.lines import animate_lines, draw_lines
from coil_rl.report import style

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
    shown = (style.ASPHALT, style.LEFT_CONE, style.RIGHT_CONE, style.GUIDES[0], style.AGENTS[0])
    assert all(count(image, colour) for colour in shown)
    draw_lines(TRACKS, LINES, tmp_path / "crash.png", crashed={"agent": [False, True]})
    assert (image != pixels(tmp_path / "crash.png")).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    "lines",
    [
        {},
        {"agent": [[], []]},
        {"agent": [driven(8, 1)[:1], 1e4 * driven(8, 9)]},
        {"$\\frac$": [driven(8, 1)[:2], []]},
    ],
)
def test_lines_may_be_short_missing_or_outside_of_the_map(lines, tmp_path):
    crashed = {label: [True, True] for label in lines}
    draw_lines(TRACKS, lines, tmp_path / "lines.png", crashed=crashed)
    animate_lines(TRACKS, lines, tmp_path / "lines.gif", rate=24, crashed=crashed)
    assert {file.name for file in tmp_path.iterdir()} == {"lines.png", "lines.gif"}


def test_arrays_tensors_and_lists_give_the_same_figure_without_rows_that_are_not_finite(tmp_path):
    line = driven(8, 10)
    with_gaps = np.insert(line, [0, 50, len(line)], math.nan, axis=0)
    images = []
    for index, given in enumerate([line, torch.from_numpy(line), line.tolist(), with_gaps]):
        draw_lines(TRACKS[:1], {"agent": [given]}, tmp_path / f"{index}.png")
        images.append(pixels(tmp_path / f"{index}.png"))
    assert all((image == images[0]).all() for image in images)


def test_animation_moves_repeats_and_is_small(tmp_path):
    path = tmp_path / "lines.gif"
    animate_lines(TRACKS, LINES, path, rate=24, crashed={"agent": [False, True]}, seconds=1)
    with Image.open(path) as image:
        assert image.info["loop"] == 0
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(image)]
    assert durations == [100] * 10 + [1200]
    assert all((before != after).any() for before, after in itertools.pairwise(frames))
    assert path.stat().st_size < 250_000
