import math

import numpy as np
import pytest
from programs import read_csv

from coil_paper.reproduce.figures import Figure10, Figure19, Figure21, Figure26, Figure30, Figure31
from coil_rl.envs import robot_track, shipped_track


def series_of(figure, folder):
    """Make a figure; return its page, and the points [N, 2] of its series by panel and name."""
    page = figure.make(folder / "figure")
    assert (folder / "figure.png").exists()
    series = {}
    for row in read_csv(folder / "figure.csv"):
        series.setdefault((row["panel"], row["series"]), []).append(
            (float(row["x"]), float(row["y"]))
        )
    return page, {key: np.array(points) for key, points in series.items()}


def in_order(points):
    return np.sort_complex(points @ [1, 1j])


@pytest.mark.slow
def test_figure_10_is_the_clipped_term_and_red_where_it_is_flat(tmp_path):
    page, series = series_of(Figure10(), tmp_path)
    for title, sign in (("A < 0", -1), ("A > 0", 1)):
        ratio, term = series[title, "one term"].T
        assert ratio == pytest.approx(np.linspace(0.005, 1.995, 200), abs=1e-5)
        clipped = np.minimum(sign * ratio, sign * ratio.clip(0.8, 1.2))
        assert term == pytest.approx(clipped, abs=1e-5)
        clipped = series[title, "clipped"]
        assert clipped[:, 1] == pytest.approx(sign * (1 + 0.2 * sign), abs=1e-5)
        assert len(clipped) == 80
    assert "at ratios up to 0.795 for a negative advantage A, and from 1.205 on" in page


@pytest.mark.slow
def test_figure_19_has_the_cones_in_sight_and_nothing_else_detected(tmp_path):
    page, series = series_of(Figure19("test_3", 5.33), tmp_path)
    ends = series["", "detected"].reshape(-1, 2, 2)
    cones = np.concatenate([series["", f"{side} cones"] for side in ("left", "right")])
    distance, bearing = np.hypot(*cones.T), np.abs(np.degrees(np.arctan2(*cones.T)))
    expected = cones[(distance <= 7) & (bearing <= 60)]
    assert (ends[:, 0] == 0).all()
    assert in_order(ends[:, 1]) == pytest.approx(in_order(expected), abs=1e-4)
    assert "on test_3 after 5.33 s" in page
    assert "1 on the left and 5 on the right" in page
    for side in ("left", "right"):
        assert len(series["", f"estimate of the {side} boundary"]) == 5


def test_figure_21_shows_the_cones_of_four_training_tracks(tmp_path):
    page, series = series_of(Figure21(), tmp_path)
    assert {panel for panel, _ in series} == {"train_1", "train_2", "train_3", "train_4"}
    assert series["train_2", "left cones"].tolist() == shipped_track("train_2").left.tolist()
    assert f"train_4 {shipped_track('train_4').length:.1f} m" in page


def test_figure_26_detects_cones_among_the_points_of_the_scan(tmp_path):
    page, series = series_of(Figure26(), tmp_path)
    names = ("LiDAR points", "left cones", "right cones")
    points, left, right = (series["", name] for name in names)
    assert f"{len(points)} returns" in page
    assert f"{len(left)} thin cones, the left side, and {len(right)} thick ones" in page
    for cone in np.concatenate([left, right]):
        assert np.hypot(*cone) <= 1.0
        assert np.hypot(*(points - cone).T).min() < 0.05
    assert len(left) + len(right) < len(robot_track().left) + len(robot_track().right)


def test_figure_30_is_equation_103(tmp_path):
    _, series = series_of(Figure30(), tmp_path)
    assert len(series) == 5
    for (_, name), curve in series.items():
        alpha, beta = curve.T
        distance = float(name.removeprefix("d = ").removesuffix(" m"))
        assert alpha.tolist() == pytest.approx(range(-60, 61))
        assert beta == pytest.approx(160 / math.pi * np.arctan(alpha / distance**1.8))


@pytest.mark.slow
def test_figure_31_has_midpoints_of_pairs_and_targets_on_the_spline(tmp_path):
    page, series = series_of(Figure31(), tmp_path)
    names = ("left cones", "right cones", "midpoints of pairs")
    left, right, midpoints = (series["midpoints", name] for name in names)
    pairs = (left[:, None] + right)[np.hypot(*np.moveaxis(left[:, None] - right, -1, 0)) < 4] / 2
    assert in_order(midpoints) == pytest.approx(in_order(pairs), abs=1e-5)
    spline, targets = series["targets", "smoothing spline"], series["targets", "targets"]
    assert all(np.hypot(*(spline - target).T).min() < 0.06 for target in targets)
    assert f"{len(pairs)} midpoints" in page
    assert f"{len(targets)} targets" in page


def test_values_out_of_range_are_rejected():
    with pytest.raises(ValueError, match="seconds=-1 must be at least 0"):
        Figure19(seconds=-1)
    with pytest.raises(ValueError, match="train_9"):
        Figure31("train_9")
