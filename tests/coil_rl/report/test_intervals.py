import math

from matplotlib.figure import Figure

from coil_rl.report.intervals import Interval, draw_panel

ROWS = [
    Interval("ppo", 660.0, 650.0, 670.0, [649.0, 660.0, 671.0], guide=630.0),
    Interval("coil", 650.0, 640.0, 655.0, [640.0, 655.0], guide=630.0),
    Interval("coil, zeroed", 400.0, guide=600.0, hollow=True),
]


def test_panel_shows_the_given_values():
    axes = Figure().add_subplot()
    draw_panel(axes, dict(enumerate(ROWS)))
    drawn = [(list(line.get_xdata()), list(line.get_ydata())) for line in axes.get_lines()]
    assert ([650.0, 670.0], [0, 0]) in drawn
    assert ([649.0, 660.0, 671.0], [0, 0, 0]) in drawn
    guides = [(x, y) for x, y in drawn if len(x) == 2 and x[0] == x[1]]
    assert guides == [([630, 630], [-0.5, 1.5]), ([600, 600], [1.5, 2.5])], (
        "adjacent rows share the line of a guide"
    )
    assert any(math.isnan(x[0]) for x, _ in drawn), "no bar without an interval"
