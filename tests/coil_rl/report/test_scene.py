import pytest

from coil_rl.envs import Track, robot_track
from coil_rl.report import style
from coil_rl.report.scene import Scene


def scaled(times):
    here = robot_track()
    return Track("scaled", left=times * here.left, right=times * here.right)


@pytest.mark.parametrize(("times", "bar"), [(7, "10 m"), (1, "1 m")])
def test_the_scale_bar_is_a_round_length_that_fits(times, bar):
    scene = Scene([scaled(times)], title=None, dpi=100)
    texts = {text.get_text(): text for text in scene.axes.texts}
    assert bar in texts
    line = next(line for line in scene.axes.lines if len(line.get_xdata()) == 4)
    inches = (max(line.get_xdata()) - min(line.get_xdata())) * scene.scale
    assert 0.1 < inches <= style.WIDTH / 2
    assert inches / scene.scale == pytest.approx(float(bar.removesuffix(" m")))
