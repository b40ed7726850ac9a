import numpy as np
import pytest
from matplotlib.colors import to_rgb
from ovals import oval_line, oval_track
from PIL import Image

from coil_rl.report import draw_listening_map
from coil_rl.report.listening_map import COLOURS

TRACKS = [oval_track("one"), oval_track("two", clockwise=True)]
LINES = [oval_line(10), oval_line(10) * [1, -1]]


def constant(*values):
    return [np.full(len(line), value) for line, value in zip(LINES, values, strict=True)]


def picture(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def pixels_of(pixels, colour):
    """How many pixels above the colour bar have it."""
    return int((np.abs(pixels[:-80] - 255 * np.array(to_rgb(colour))).max(-1) < 3).sum())


def test_each_guide_has_its_row_and_all_share_the_colours(tmp_path):
    draw_listening_map(TRACKS, LINES, {"loud": constant(0.4, 0.4)}, tmp_path / "one.png", label="moved")
    draw_listening_map(
        TRACKS,
        LINES,
        {"loud": constant(0.4, 0.4), "mute": constant(0, 0)},
        tmp_path / "two.png",
        label="moved",
        title="t",
    )
    one, two = picture(tmp_path / "one.png"), picture(tmp_path / "two.png")
    assert one.shape[1] == two.shape[1] == 1600
    assert two.shape[0] > 1.4 * one.shape[0]
    assert pixels_of(one, COLOURS(1.0)) == pytest.approx(pixels_of(two, COLOURS(1.0)), rel=0.1)
    assert pixels_of(one, COLOURS(0.0)) == 0
    assert pixels_of(two, COLOURS(0.0)) == pytest.approx(pixels_of(two, COLOURS(1.0)), rel=0.1)


def test_what_is_not_finite_is_left_out_and_nothing_at_all_is_a_picture(tmp_path):
    draw_listening_map(TRACKS, LINES, {"guide": constant(np.nan, 0.2)}, tmp_path / "half.png", label="moved")
    draw_listening_map(TRACKS, LINES, {"guide": constant(0.2, 0.2)}, tmp_path / "full.png", label="moved")
    half, full = (pixels_of(picture(tmp_path / f"{name}.png"), COLOURS(1.0)) for name in ("half", "full"))
    assert half == pytest.approx(full / 2, rel=0.1)
    nothing = {"guide": [np.zeros(1), np.zeros(1)]}
    draw_listening_map(TRACKS, [line[:1] for line in LINES], nothing, tmp_path / "none.png", label="moved")
    draw_listening_map(TRACKS, LINES, {"guide": constant(np.nan, np.nan)}, tmp_path / "nan.png", label="moved")


def test_values_must_match_the_lines(tmp_path):
    path = tmp_path / "map.png"
    with pytest.raises(ValueError, match="at least one guide"):
        draw_listening_map(TRACKS, LINES, {}, path, label="moved")
    with pytest.raises(ValueError, match="The values of 'guide' have the shapes"):
        draw_listening_map(TRACKS, LINES, {"guide": constant(1, 1)[:1]}, path, label="moved")
    with pytest.raises(ValueError, match="give one value a point"):
        draw_listening_map(TRACKS, LINES, {"guide": [np.zeros(3), np.zeros(3)]}, path, label="moved")
    assert not path.exists()
