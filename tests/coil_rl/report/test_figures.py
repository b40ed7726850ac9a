import pytest
from run_folders import driven, make_run

from coil_rl.report import style
from coil_rl.report.curves import draw_curve_grid, draw_learning_curves
from coil_rl.report.figures import _learning_curves
from coil_rl.report.runs import read_runs


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(
    ("other", "drawn"), [(3.1, draw_curve_grid), (3.000001, draw_learning_curves)]
)
def test_different_guides_have_their_own_lines_in_any_unit(unit, other, drawn, tmp_path):
    for label, guide in {"a": 3.0, "b": other}.items():
        rows = driven(label, {"x": unit})
        make_run(tmp_path / label, label, 0, rows, guide=guide * unit)
    draw = _learning_curves(read_runs([tmp_path]), style.strong_strokes(["a", "b"]))
    assert draw.func is drawn
