import csv
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image
from scipy.interpolate import make_smoothing_spline

from coil_rl.envs import shipped_track
from coil_rl.reproduce import FigureSpline
from coil_rl.reproduce.figure_spline import fit


@pytest.mark.parametrize("smoothing", [0.0, 0.01, 0.1, 1.0, 30.0])
def test_ours_is_scipys_and_its_roughness_the_integral(smoothing):
    truth = shipped_track("test_1").right[:12]
    points = truth + np.random.default_rng(1).normal(0, 0.3, truth.shape)
    found = fit(points, truth, smoothing)
    u = np.concatenate([[0], np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum()])
    scipy = make_smoothing_spline(u, points, lam=smoothing)
    assert found.curve == pytest.approx(scipy(np.linspace(0, u[-1], len(found.curve))), abs=1e-9)
    assert 0 < found.difference < 1e-9 < found.single < 1e-4
    assert found.residual == pytest.approx(((scipy(u) - points) ** 2).sum(), abs=1e-9)
    middle = (np.arange(20_000) + 0.5) / 20_000 * u[-1]
    assert found.roughness == pytest.approx((scipy.derivative(2)(middle) ** 2).sum() * u[-1] / 20_000, rel=1e-6)


def test_without_noise_or_smoothing_the_curve_goes_through_the_true_cones():
    truth = shipped_track("test_1").right[:12]
    found = fit(truth, truth, 0.0)
    assert (found.residual, found.error) == (0, 0)


def test_page_numbers_and_picture(tmp_path):
    page = FigureSpline(seed=3).make(tmp_path / "f")
    with (tmp_path / "f.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    fits = [{key: float(value) for key, value in row.items() if value and key != "curve"} for row in rows[:5]]
    assert [row["smoothing"] for row in fits] == [0, 0.1, 1, 10, 100]
    assert max(row["difference"] for row in fits) < 1e-6
    for less, more in pairwise(fits):
        assert more["residual"] > less["residual"]
        assert more["roughness"] < less["roughness"]
        assert f" {more['residual']:.4f} | " in page
    places = [(float(row["x"]), float(row["y"])) for row in rows if row["curve"] == "true cone"]
    assert places == [tuple(cone) for cone in shipped_track("test_3").left[:16]]
    with Image.open(tmp_path / "f.png") as image:
        assert image.width == 1600


def test_the_noise_is_that_of_the_seed():
    assert np.array_equal(FigureSpline(seed=2).points, FigureSpline(seed=2).points)
    assert not np.array_equal(FigureSpline(seed=2).points, FigureSpline(seed=3).points)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"track": "monza"}, "no shipped track 'monza'"),
        ({"side": "middle"}, "side='middle' must be one of left, right"),
        ({"cones": 4}, "cones=4 must be 5 to 69, the left cones of test_3"),
        ({"noise": -1.0}, "noise=-1.0 must be a finite number of at least 0"),
        ({"seed": -1}, "seed=-1 at least 0"),
        ({"smoothings": []}, "must be one number or several"),
        ({"smoothings": [1, 1]}, "none of them twice"),
        ({"smoothings": [1, float("nan")]}, "smoothings holds nan"),
    ],
)
def test_mistakes_are_refused(wrong, words):
    with pytest.raises(ValueError, match=words):
        FigureSpline(**wrong)
