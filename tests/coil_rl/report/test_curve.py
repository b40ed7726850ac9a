import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from coil_rl.report.curve import EVALUATION, TRAINING, draw_learning_curves, mean_curve

Row = dict[str, object]


def run(seed: int, rows: int = 40, every: int = 8) -> list[Row]:
    rng = np.random.default_rng(seed)
    made: list[Row] = []
    for index in range(rows):
        value = 300 * (1 - math.exp(-index / 10)) + float(rng.normal())
        row: Row = {"frames": 50_000 * (index + 1), TRAINING: value if index else math.nan}
        if index % every == every - 1:
            row[EVALUATION] = value + 10
        made.append(row)
    return made


@pytest.mark.parametrize(
    "runs",
    [
        {"COIL": [run(0)]},
        {"COIL": [run(0), run(1), run(2)], "PPO": [run(3, rows=20)]},
        {"COIL": [run(0)], "PPO": []},
        {str(index): [run(index)] for index in range(8)},
    ],
)
def test_a_curve_is_a_picture(runs: dict[str, list[list[Row]]], tmp_path: Path) -> None:
    draw_learning_curves(runs, tmp_path / "curve.png", guides={"guide": 243.2}, title="Learning")
    with Image.open(tmp_path / "curve.png") as image:
        assert image.size == (1600, 840)
        assert len(image.convert("RGB").getcolors(1 << 20) or []) > 50
    assert list(tmp_path.iterdir()) == [tmp_path / "curve.png"]


@pytest.mark.parametrize(
    "rows",
    [
        [],
        [{"frames": 0, TRAINING: None}],
        [{"frames": 100}, {"frames": 200, TRAINING: math.nan}],
        [{"frames": 100, EVALUATION: 5.0}],
        [{"frames": 5_000, TRAINING: np.float32(1.0)}, {"frames": np.int64(10_000), TRAINING: 2.0}],
    ],
)
def test_rows_may_be_few_or_without_values(rows: list[Row], tmp_path: Path) -> None:
    draw_learning_curves({"COIL": [rows]}, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000


def test_a_single_run_is_shown_as_it_is() -> None:
    rows: list[Row] = [{"frames": f, TRAINING: v} for f, v in ((20, 2.0), (10, 1.0), (30, math.nan), (40, 4.0))]
    frames, mean, low, high = mean_curve([rows], TRAINING)
    np.testing.assert_array_equal(frames, [10, 20, 40])
    np.testing.assert_array_equal(mean, [1, 2, 4])
    np.testing.assert_array_equal(low, mean)
    np.testing.assert_array_equal(high, mean)


def test_runs_are_averaged_where_all_of_them_are() -> None:
    first: list[Row] = [{"frames": f, TRAINING: 1.0 * f} for f in (0, 10, 20, 30)]
    second: list[Row] = [{"frames": f, TRAINING: 3.0 * f} for f in (5, 15, 25)]
    frames, mean, low, high = mean_curve([first, second, []], TRAINING)
    np.testing.assert_array_equal(frames, [5, 10, 15, 20, 25])
    np.testing.assert_allclose(mean, 2 * frames)
    np.testing.assert_allclose(low, 1 * frames)
    np.testing.assert_allclose(high, 3 * frames)


def test_the_band_covers_the_true_mean_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(300, 20))
    hits = 0
    for of_repeat in values:
        runs: list[list[Row]] = [[{"frames": 1, TRAINING: float(value)}] for value in of_repeat]
        _, _, low, high = mean_curve(runs, TRAINING)
        hits += bool(low[0] <= 0 <= high[0])
    assert 0.88 < hits / len(values) < 0.97


def test_runs_that_never_overlap_have_nomean_curve(tmp_path: Path) -> None:
    early, late = run(0, rows=3), [{**row, "frames": 1e9} for row in run(1, rows=3)]
    assert len(mean_curve([early, late], TRAINING)[0]) == 0
    draw_learning_curves({"COIL": [early, late]}, tmp_path / "curve.png")


def test_what_cannot_be_drawn_is_said(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one run; got none for: COIL, PPO"):
        draw_learning_curves({"COIL": [], "PPO": []}, tmp_path / "curve.png")
    with pytest.raises(ValueError, match="at least one run; got none for: no label"):
        draw_learning_curves({}, tmp_path / "curve.png")
    with pytest.raises(ValueError, match="no 'frames'; it has: step, train/return"):
        draw_learning_curves({"COIL": [[{"step": 1, TRAINING: 2.0}]]}, tmp_path / "curve.png")
    with pytest.raises(ValueError, match="xyz"):
        draw_learning_curves({"COIL": [run(0)]}, tmp_path / "curve.xyz")
    assert list(tmp_path.iterdir()) == []
