import numpy as np
import pytest
from PIL import Image

from coil_rl.report.curve import TRAINING
from coil_rl.report.curve_grid import draw_curve_grid


def runs_of(labels, seeds=2):
    rng = np.random.default_rng(0)
    return {
        f"label {k}": [
            [{"frames": 1e5 * n, TRAINING: n + k + float(rng.normal())} for n in range(8)] for _ in range(seeds)
        ]
        for k in range(labels)
    }


@pytest.mark.parametrize(("labels", "rows"), [(1, 1), (2, 1), (6, 2), (7, 3)])
def test_a_grid_has_a_small_picture_for_each_label(labels, rows, tmp_path):
    draw_curve_grid(runs_of(labels), tmp_path / "grid.png", guides={"label 0": 3.0}, title="Learning")
    with Image.open(tmp_path / "grid.png") as image:
        assert image.width == 1600
        assert 1.5 * rows < image.height / 200 < 1.6 * rows + 1.2
        assert len(image.convert("RGB").getcolors(1 << 20) or []) > 50


def test_each_guide_is_drawn_where_it_belongs(tmp_path):
    runs = runs_of(2)
    draw_curve_grid(runs, tmp_path / "first.png", guides={"label 0": 3.0})
    draw_curve_grid(runs, tmp_path / "second.png", guides={"label 1": 3.0})
    with Image.open(tmp_path / "first.png") as first, Image.open(tmp_path / "second.png") as second:
        differs = (np.asarray(first) != np.asarray(second)).any(axis=(0, 2))
    assert differs[:800].any()
    assert differs[800:].any()


def test_labels_without_a_value_leave_their_picture_empty(tmp_path):
    draw_curve_grid({"a": [[{"frames": 1, TRAINING: float("nan")}]], "b": [[]]}, tmp_path / "grid.png")
    assert (tmp_path / "grid.png").stat().st_size > 1000


def test_nothing_to_draw_is_said(tmp_path):
    with pytest.raises(ValueError, match="at least one label"):
        draw_curve_grid({}, tmp_path / "grid.png")
    with pytest.raises(ValueError, match="has no 'frames'"):
        draw_curve_grid({"a": [[{"step": 1}]]}, tmp_path / "grid.png")
    assert not list(tmp_path.iterdir())
