import numpy as np

from coil_rl.report import style
from coil_rl.report.guide_use import draw_guide_use, guide_use
from coil_rl.report.runs import Run

NAN = float("nan")


def run(label, column, values, seed=0):
    """Return a run of four rows with a column besides the frames."""
    rows = [{"frames": 100.0 * number, column: value} for number, value in enumerate(values)]
    return Run(None, label, seed, True, curve=rows)


def test_weight_that_was_decided_before_the_training_lasts_for_the_run():
    use = guide_use([run("coil_anchored", "start/weight", [0.5, NAN, NAN, NAN])])
    (curve,) = use["start/weight"]["coil_anchored"]
    assert curve.tolist() == [[0, 0.5], [300, 0.5]]


def test_what_methods_log_of_their_guide_is_found_by_column_and_label():
    runs = [
        run("kickstart", "learner/guide_weight", [NAN, 1.0, 0.5, 0.0], seed=0),
        run("kickstart", "learner/guide_weight", [NAN, 1.0, 0.5, 0.0], seed=1),
        run("ppo", "learner/loss", [NAN, 1.0, 2.0, 3.0]),
        run("cheq", "train/agent_weight", [NAN] * 4),
        Run(None, "guide", 0, None),
    ]
    use = guide_use(runs)
    assert list(use) == ["learner/guide_weight"]
    one, other = use["learner/guide_weight"]["kickstart"]
    assert one.tolist() == other.tolist() == [[100, 1], [200, 0.5], [300, 0]]
    assert not guide_use(runs[2:])


def test_every_column_is_drawn(tmp_path):
    use = {column: {"coil": [np.ones((2, 2))]} for column in ("start/weight", "train/agent_acts")}
    draw_guide_use(use, tmp_path / "use.png", style.strong_strokes(["coil"]))
    assert (tmp_path / "use.png").exists()
