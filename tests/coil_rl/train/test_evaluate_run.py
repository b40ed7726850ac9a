import pytest
from hydra import compose, initialize_config_module

from coil_rl.train.build import build_guides
from coil_rl.train.evaluate_run import drive_guides

TINY = ["env.time_limit=1", "guide=[spline,random]", "run_dir=unused"]


@pytest.fixture
def composed():
    with initialize_config_module("coil_rl.conf", version_base="1.3"):
        yield lambda *overrides: compose("train", [*TINY, *overrides])


def drive(config, guides=None):
    return drive_guides(config, config.evaluation.env, ["a", "b", "c"], guides)


def test_guides_of_a_sweep_are_driven_once(composed):
    first, again = (drive(composed(f"method={method}")) for method in ("coil", "ppo"))
    assert list(first) == ["guide spline", "guide random"]
    assert all(again[driver] is result for driver, result in first.items())


@pytest.mark.parametrize("change", ["seed=1", "degrade=delayed", "env.smoothing=0.2"])
def test_guides_are_driven_again_after_a_change_of_guide_or_env(composed, change):
    first, others = drive(composed()), drive(composed(change))
    assert all(others[driver] is not result for driver, result in first.items())


def test_given_guides_are_not_cached(composed):
    config = composed()
    cached, given = drive(config), drive(config, build_guides(config))
    assert given["guide spline"] is not cached["guide spline"]
    assert given["guide spline"].mean_reward == cached["guide spline"].mean_reward
