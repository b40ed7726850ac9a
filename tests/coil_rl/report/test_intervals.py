import math

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from coil_rl.report.intervals import Interval, _draw_panel, draw_intervals

LINES = [
    Interval("ppo", 660.0, 650.0, 670.0, [649.0, 660.0, 671.0], guide=630.0),
    Interval("coil", 650.0, 640.0, 655.0, [640.0, 655.0], guide=630.0),
    Interval("coil, zeroed", 400.0, guide=600.0, hollow=True),
]


def size(path):
    with Image.open(path) as image:
        assert len(image.convert("RGB").getcolors(1 << 20) or []) > 30
        return image.size


def test_a_plot_is_as_high_as_it_has_lines(tmp_path):
    draw_intervals({"deterministic actions": LINES}, tmp_path / "few.png", title="Placebo")
    draw_intervals({"one": [Interval(str(k), k) for k in range(20)]}, tmp_path / "many.png")
    (width, few), (same, many) = size(tmp_path / "few.png"), size(tmp_path / "many.png")
    assert width == same == 1600
    assert many > few + 15 * 0.2 * 200


def test_panels_share_their_drivers_in_whatever_order_they_come(tmp_path):
    draw_intervals({"one": LINES, "other": LINES[::-1]}, tmp_path / "both.png")
    draw_intervals({"one": LINES, "other": LINES}, tmp_path / "same.png")
    with Image.open(tmp_path / "both.png") as both, Image.open(tmp_path / "same.png") as same:
        # Only the other order of drawing may show, where two edges meet.
        assert both.size == same.size
        assert np.abs(np.asarray(both, dtype=int) - np.asarray(same, dtype=int)).mean() < 0.05


def test_what_is_drawn_is_what_was_given():
    axes = Figure().add_subplot()
    _draw_panel(axes, dict(enumerate(LINES)))
    drawn = [(line.get_xdata(), line.get_ydata()) for line in axes.get_lines()]
    assert ([650.0, 670.0], [0, 0]) in [(list(x), list(y)) for x, y in drawn]
    assert ([649.0, 660.0, 671.0], [0, 0, 0]) in [(list(x), list(y)) for x, y in drawn]
    guides = [(list(x), list(y)) for x, y in drawn if len(x) == 2 and x[0] == x[1]]
    assert guides == [([630, 630], [-0.5, 1.5]), ([600, 600], [1.5, 2.5])], (
        "neighbours with the same guide share a line"
    )
    assert any(math.isnan(x[0]) for x, _ in drawn), "no bar where there is no interval"


@pytest.mark.parametrize("panels", [{}, {"one": []}])
def test_nothing_to_draw_is_said(panels, tmp_path):
    with pytest.raises(ValueError, match="at least one driver"):
        draw_intervals(panels, tmp_path / "plot.png")
    assert not list(tmp_path.iterdir())
