import io
import math

import numpy as np
import pytest
from scipy.stats import t

from coil_rl.report.curves import (
    draw_curve_grid,
    draw_learning_curves,
    draw_phases,
    frames_until,
    mean_curve,
)
from coil_rl.report.runs import RETURN

NAN = math.nan


def run(seed, rows=40):
    values = [math.nan, *np.random.default_rng(seed).normal(300, size=rows - 1)]
    return [{"frames": 50_000 * n, RETURN: value} for n, value in enumerate(values, 1)]


@pytest.mark.parametrize("draw", [draw_learning_curves, draw_curve_grid])
@pytest.mark.parametrize(
    "runs",
    [
        {"COIL": [run(0), run(1), run(2)], "PPO": [run(3, rows=20)]},
        {str(index): [run(index)] for index in range(8)},
        {"no values": [[{"frames": 0, RETURN: None}, {"frames": 9}, {"frames": 12, RETURN: NAN}]]},
        {"no common frames": [run(0, rows=3), [{**row, "frames": 1e9} for row in run(1, rows=3)]]},
    ],
)
def test_learning_curves_are_drawn_for_any_number_of_runs_and_values(draw, runs, tmp_path):
    draw(runs, tmp_path / "curve.png", guides={next(iter(runs)): 243.2})
    assert list(tmp_path.iterdir()) == [tmp_path / "curve.png"]


def test_phases_are_drawn_for_guides_in_turn_and_together(tmp_path):
    columns = ("frames", "learner/guide", "learner/learning_rate", "learner/guide_learning_rate")
    phases = [(1000.0, -1, 1e-3, 0.0), (2000.0, 0, 0.0, 1e-4), (3000.0, 2, 1e-3, 1e-4)]
    rows = [dict(zip(columns, phase, strict=True)) | {"guide/b": 100.0} for phase in phases]
    draw_phases(rows, ["a", "b"], tmp_path / "phases.png", title="Phases")
    assert (tmp_path / "phases.png").exists()


def test_single_run_is_its_own_mean_and_interval():
    points = [(20, 2.0), (10, np.float32(1)), (30, math.nan), (40, 4.0)]
    rows = [{"frames": frames, RETURN: value} for frames, value in points]
    frames, *curves = mean_curve([rows], RETURN)
    np.testing.assert_array_equal(frames, [10, 20, 40])
    for curve in curves:
        np.testing.assert_array_equal(curve, [1, 2, 4])


def test_runs_are_averaged_over_their_common_frames():
    first = [{"frames": f, RETURN: 1.0 * f} for f in (0, 10, 20, 30)]
    second = [{"frames": f, RETURN: 3.0 * f} for f in (5, 15, 25)]
    frames, mean, low, high = mean_curve([first, second, []], RETURN)
    np.testing.assert_array_equal(frames, [5, 10, 15, 20, 25])
    middle, half = 2 * frames, t.ppf(0.975, 1) * frames
    np.testing.assert_allclose([mean, low, high], [middle, middle - half, middle + half])


def test_frames_until_a_level_are_interpolated():
    frames, returns = [0, 100, 200, 300], [0.0, 50.0, 40.0, 90.0]
    assert [frames_until(frames, returns, level) for level in (50, 65, -1)] == [100, 250, 0]
    assert all(math.isnan(frames_until(frames, returns, level)) for level in (91, math.nan))


def test_curve_below_the_axis_is_said():
    bad = [{"frames": n, RETURN: -9e4} for n in range(5)]
    picture = io.BytesIO()
    draw_learning_curves({"good": [run(0)], "bad": [bad]}, picture, least=200.0)
    text = picture.getvalue().decode()
    assert "bad ends at -90000.0" in text
    assert "good ends" not in text
