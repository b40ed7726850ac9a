import math

import pytest
from PIL import Image

from coil_rl.report import draw_phases


def rows(updates=24):
    """Two guides in turn after every second phase."""
    found = []
    for update in range(updates):
        phase = update // 4
        guide = -1 if phase % 2 == 0 else phase // 2 % 2
        found.append({
            "frames": 1000.0 * (update + 1), "train/return": math.nan if update < 5 else 10.0 * update,
            "learner/phase": phase, "learner/guide": guide,
            "learner/learning_rate": 1e-3 * 0.9**phase if guide < 0 else 0.0,
            "learner/guide_learning_rate": 0.0 if guide < 0 else 1e-4,
            "learner/moved_a": 0.01 * phase, "learner/moved_b": 0.005 * phase,
            "guide/a": 200.0 if update in (0, 23) else math.nan, "guide/b": 100.0 if update == 0 else math.nan,
        })  # fmt: skip
    return found


def test_each_phase_in_which_a_guide_learns_has_its_colour(tmp_path):
    draw_phases(rows(), ["a", "b"], tmp_path / "phases.png", title="Phases")
    with Image.open(tmp_path / "phases.png") as picture:
        assert picture.width == 1600
        colours = {colour for _, colour in picture.convert("RGB").getcolors(picture.width * picture.height)}
        ground = picture.convert("RGB").getcolors(picture.width * picture.height)
    tinted = [colour for count, colour in ground if count > 8000 and colour != (255, 255, 255)]
    assert len(tinted) >= 2
    assert len(colours) > 10


def test_one_phase_of_everybody_is_drawn_too(tmp_path):
    joint = [
        row | {"learner/guide": 2, "learner/guide_learning_rate": 1e-4, "learner/learning_rate": 1e-3} for row in rows()
    ]
    draw_phases(joint[:1], ["a", "b"], tmp_path / "joint.png")
    assert (tmp_path / "joint.png").stat().st_size > 10_000


def test_nothing_to_draw_is_refused(tmp_path):
    with pytest.raises(ValueError, match="needs at least one row"):
        draw_phases([], ["a"], tmp_path / "none.png")
